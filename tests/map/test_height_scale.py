import numpy as np
import pytest
from matplotlib import colormaps
from triquad_map.height_scale import HEIGHT_STOPS, HeightScale


def test_stops_are_those_of_viridis():
    wanted = colormaps["viridis"](np.linspace(0.25, 1.0, len(HEIGHT_STOPS)))[:, :3]
    np.testing.assert_allclose(HEIGHT_STOPS, wanted, atol=6e-4)


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
