"""Maps of Nav2 that ``triquad-pack`` writes, read by the rules of map_server."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from PIL import Image
from support.maps.exact_maps import SEEN_M, Height, exact_map, flat, table
from support.maps.map_records import random_record
from support.maps.small_world import settled_epoch, world
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.crop import crop_record
from triquad_tools.mapfiles.occupancy import HEIGHT_M, STEP_M

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # of nav_msgs/OccupancyGrid, which map_server publishes
FAR = (450_000.0, 5_400_000.0, 400.0)
Packed = Callable[..., "Served"]


@dataclass(frozen=True)
class Served:
    """A grid as map_server publishes it."""

    values: NDArray[np.int8]  # [y, x] from the least y on
    x: NDArray[np.float64]  # [columns] middles of cells, metres, map frame
    y: NDArray[np.float64]  # [rows]

    def at(self, x: float, y: float) -> int:
        row, column = np.abs(self.y - y).argmin(), np.abs(self.x - x).argmin()
        return int(self.values[row, column])


def served(path: Path) -> Served:
    """As https://wiki.ros.org/map_server says of trinary maps."""
    facts = yaml.safe_load(path.read_text())
    assert (facts["mode"], facts["negate"]) == ("trinary", 0)
    with Image.open(path.parent / facts["image"]) as image:
        assert image.mode == "L"
        pixels = np.asarray(image).astype(float)
    share = (255 - pixels) / 255
    values = np.full(pixels.shape, UNKNOWN, np.int8)
    values[share > facts["occupied_thresh"]] = OCCUPIED
    values[share < facts["free_thresh"]] = FREE
    x, y, yaw = facts["origin"]  # of the lower left corner
    assert yaw == 0
    rows, columns = ((np.arange(count) + 0.5) * facts["resolution"] for count in pixels.shape)
    return Served(values[::-1], x + columns, y + rows)


@pytest.fixture
def packed(tmp_path: Path) -> Packed:
    def pack(record: MapRecord, *options: str) -> Served:
        source, out = tmp_path / "in.triquad", tmp_path / "plan.yaml"
        write_map(record, source, feature_dtype="<f4")
        assert main([str(source), str(out), "--force", *options]) == 0
        return served(out)

    return pack


def test_a_table_on_the_ground(packed: Packed) -> None:
    """It is where it stands, in the coordinates of a map far away; and the rest is free."""
    record = exact_map(table(0.1, 1.1, 2.0, at=(4.0, -3.0)))
    found = packed(replace(record, origin_m=FAR))
    x, y = np.meshgrid(found.x - FAR[0], found.y - FAR[1])
    off = np.maximum(np.abs(x - 4.0), np.abs(y + 3.0)) - 1.0  # metres from the table's edge
    assert found.values.shape == (200, 200)
    assert (found.values[off < -0.2] == OCCUPIED).all()  # the field falls off in a leaf
    assert (found.values[off > 0.25] == FREE).all()
    assert np.abs(x).max() == pytest.approx(SEEN_M - 0.05, abs=1e-4)


def sloping(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.3 * x + 0.0 * y


@pytest.mark.parametrize("height", [flat(0.1), sloping, table(0.1, 0.17, 6.0)])
def test_ground_to_drive_on(packed: Packed, height: Height) -> None:
    """A slope of 17 degrees is, and a step of 7 cm."""
    found = packed(exact_map(height))
    assert (found.values == FREE).mean() > 0.97
    assert not (found.values == OCCUPIED).any()


def test_a_kerb_is_a_line(packed: Packed) -> None:
    """What is large is ground, at any height: its edge stands in the way."""
    found = packed(exact_map(table(0.1, 0.3, 6.0)))
    x, y = np.meshgrid(found.x, found.y)
    off = np.maximum(np.abs(x), np.abs(y)) - 3.0
    assert (found.values[np.abs(off) > 0.3] == FREE).all()
    for way in np.linspace(-2.8, 2.8, 30):
        across = (found.at(edge, way) for edge in np.arange(2.7, 3.3, 0.1))
        assert OCCUPIED in across


def test_a_street(packed: Packed) -> None:
    found = packed(settled_epoch(4).record(), "--crop", "-5", "-10", "-3", "20", "10", "5")
    assert found.values.shape == (200, 250)
    scene, (x, y) = world(4).scene, np.meshgrid(found.x, found.y)
    heights = np.arange(0.05, HEIGHT_M + 0.2, 0.05)
    columns = np.stack(np.broadcast_arrays(x[..., None], y[..., None], heights), axis=-1)
    clear_m = scene.sdf(columns.reshape(-1, 3)).reshape(columns.shape[:-1])
    # The ground is at most 0.14 m high there, as the pavements are.
    beyond = clear_m[:, :, heights > 0.15 + STEP_M + 0.05].min(axis=2)
    free, occupied = found.values == FREE, found.values == OCCUPIED
    assert free.mean() > 0.3
    assert occupied.sum() > 300
    assert (beyond[free] > 0).mean() > 0.99
    touched = clear_m[:, :, heights > STEP_M].min(axis=2)
    assert (touched[occupied] < 0.1).mean() > 0.95


def test_what_is_refused(tmp_path: Path, capsys) -> None:
    source, out = tmp_path / "in.triquad", tmp_path / "plan.yaml"

    def refused(status: int, text: str, record: MapRecord, *options: str) -> None:
        write_map(record, source)
        assert main([str(source), str(out), *options]) == status
        assert text in capsys.readouterr().err
        assert not out.exists()

    ground = exact_map(flat(0.1))
    wide = ["--crop", "-90", "-90", "-1", "90", "90", "2"]
    refused(2, "18,000 x 18,000 x 1 cells of 0.01 m", ground, "--cell", "0.01", *wide)
    air = ["--crop", "4", "4", "1.5", "5", "5", "2"]
    refused(1, "no ground was seen in the box of --crop", ground, *air)
    refused(1, "no surface was seen", crop_record(random_record(1), [7.9] * 3, [7.95] * 3))
    out.with_suffix(".pgm").write_bytes(b"precious")
    refused(2, "plan.pgm exists; give --force", ground)
    assert out.with_suffix(".pgm").read_bytes() == b"precious"
