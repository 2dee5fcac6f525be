import numpy as np
import pytest
from matplotlib import colormaps
from triquad_map.height_scale import HEIGHT_STOPS, HeightScale

# Machado, Oliveira and Fernandes (2009), severity 1, on linear light.
DEUTERANOPIA = [
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.011820, 0.042940, 0.968881],
]
PROTANOPIA = [
    [0.152286, 1.052583, -0.204868],
    [0.114503, 0.786281, 0.099216],
    [-0.003882, -0.048116, 1.051998],
]


def linear(colours):
    """Linear light of sRGB colours."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def oklab(light):
    """Lightness and two axes of hue ``[N, 3]`` of linear light: Ottosson (2020)."""
    cones = light @ np.transpose(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    return np.cbrt(cones) @ np.transpose(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )


def test_stops_are_those_of_viridis():
    wanted = colormaps["viridis"](np.linspace(0.25, 1.0, len(HEIGHT_STOPS)))[:, :3]
    np.testing.assert_allclose(HEIGHT_STOPS, wanted, atol=6e-4)


@pytest.mark.parametrize("sight", [np.eye(3), DEUTERANOPIA, PROTANOPIA])
def test_even_steps_look_even_to_all(sight):
    colours = HeightScale(0.0, 16.0).colours(np.arange(17.0))
    seen = oklab(np.clip(linear(colours) @ np.transpose(sight), 0.0, 1.0))
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    assert steps.min() > 0.5 * steps.max()
    assert (np.diff(seen[:, 0]) > 0).all()  # lighter all along, also in print


def test_most_heights_lie_within_the_scale():
    heights = np.append(np.linspace(-1.0, 4.0, 1001), [-500.0, 900.0])
    scale = HeightScale.around(heights)
    assert scale.low_m == pytest.approx(-0.95, abs=0.02)
    assert scale.high_m == pytest.approx(3.95, abs=0.02)
    beyond = scale.colours(np.array([-500.0, 900.0]))
    np.testing.assert_array_equal(beyond, HEIGHT_STOPS[[0, -1]])


@pytest.mark.parametrize("heights", [[], [2.0], [2.0, 2.001]])
def test_hardly_any_height_has_a_scale_too(heights):
    scale = HeightScale.around(np.array(heights))
    assert scale.high_m - scale.low_m == pytest.approx(0.1)
    assert scale.colours(np.array(heights)).shape == (len(heights), 3)
