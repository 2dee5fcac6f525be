"""OctoMap's own library reads what is written, and writes the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import octomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.maps.map_records import random_record
from triquad_client import Status
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_map.composition.composed_view import RecordedView
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.octomap import octree_bytes

TWO = ((-1, 0, 0), (0, 0, 0))
FAR = (450_000.0, 5_400_000.0, 400.0)
LEAF_M = 0.25
ROOT = 1 << 15  # cells from the middle of the tree to its sides
LABELS = np.array([-1, 0, 1])  # of the library, for UNKNOWN, FREE and SURFACE


def read(path: Path) -> octomap.OcTree:
    return octomap.OcTree(str(path).encode())


def library_bytes(voxels: NDArray[np.int64], occupied: NDArray[np.bool_]) -> bytes:
    """What the library writes of the same voxels."""
    tree = octomap.OcTree(LEAF_M)
    for middle, is_occupied in zip((voxels + 0.5) * LEAF_M, occupied.tolist(), strict=True):
        tree.updateNode(middle, is_occupied)
    data = tree.writeBinary()
    assert isinstance(data, bytes)
    return data


cell = st.one_of(st.integers(-4, 3), st.integers(-ROOT, ROOT - 1))
cells = st.dictionaries(st.tuples(cell, cell, cell), st.booleans(), min_size=1, max_size=40)


@settings(max_examples=60, deadline=None)
@given(cells)
def test_the_library_writes_the_same_bytes(voxels) -> None:
    places, occupied = np.array(list(voxels)), np.array(list(voxels.values()))
    assert octree_bytes(places, occupied, LEAF_M) == library_bytes(places, occupied)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 5), st.sampled_from([-ROOT, -5, 0, ROOT - 5]))
def test_dense_blocks_are_pruned_as_the_library_does(seed, side, corner) -> None:
    """Of large pieces of the same state there are some in each."""
    rng = np.random.default_rng(seed)
    places = np.indices((side,) * 3).reshape(3, -1).T + corner
    occupied = (rng.random((3,) * 3) < 0.5)[tuple((places >> 1).T % 3)]
    kept = rng.random(len(places)) < 0.95
    kept[0] = True
    places, occupied = places[kept], occupied[kept]
    assert octree_bytes(places, occupied, LEAF_M) == library_bytes(places, occupied)


@pytest.fixture(scope="module")
def record() -> MapRecord:
    return random_record(3, indices=TWO, points=600, training=False)


@pytest.mark.parametrize("options", [[], ["--crop", "-5.1", "-3", "-2", "6.3", "7", "8"]])
def test_each_voxel_has_the_status_of_the_map(record: MapRecord, tmp_path, options) -> None:
    source, out = tmp_path / "in.triquad", tmp_path / "out.bt"
    write_map(record, source)
    assert main([str(source), str(out), *options]) == 0
    tree = read(out)
    assert tree.getResolution() == LEAF_M
    low, high = (-85, -34, -34), (34, 34, 34)
    axes = [np.arange(first, last) for first, last in zip(low, high, strict=True)]
    middles = (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * LEAF_M
    status = np.asarray(RecordedView(record).status(middles, 0.0))
    if options:
        box = np.reshape(np.array(options[1:], float), (2, 3))
        status[((middles < box[0]) | (middles > box[1])).any(axis=1)] = Status.UNKNOWN
    assert min(np.bincount(status)) > 50
    labels = np.concatenate([tree.getLabels(part) for part in np.array_split(middles, 10)])
    np.testing.assert_array_equal(labels, LABELS[status])


def test_it_counts_from_the_origin_of_a_map_far_away(record: MapRecord, tmp_path, capsys) -> None:
    source, out = tmp_path / "in.triquad", tmp_path / "far.bt"
    write_map(replace(record, origin_m=FAR), source)
    assert main([str(source), str(out)]) == 0
    assert "counts from the map's origin 450000 5400000 400 m" in capsys.readouterr().out
    write_map(record, source)
    assert main([str(source), str(tmp_path / "near.bt")]) == 0
    assert "counts from" not in capsys.readouterr().out
    assert out.read_bytes() == (tmp_path / "near.bt").read_bytes()


def test_what_is_refused(tmp_path, capsys) -> None:
    source, out = tmp_path / "in.triquad", tmp_path / "out.bt"
    wide = random_record(1, indices=((0, 0, 0), (700, 0, 0)), training=False)
    write_map(wide, source)

    def refused(status: int, text: str, *options: str) -> None:
        assert main([str(source), str(out), *options]) == status
        assert text in capsys.readouterr().err
        assert not out.exists()

    refused(2, "reaches 8,192 m from the map's origin, 32,768 cells of 0.25 m, and the map 8,40")
    refused(2, "--cell is of meshes and grids: .bt has the map's leaves", "--cell", "0.1")
    refused(2, "--fill is of what can mark it", "--fill", "1")
    refused(1, "of --crop", "--crop", "900", "0", "0", "901", "1", "1")
    near = ["--crop", "-8", "-8", "-8", "8", "8", "8"]
    assert main([str(source), str(out), *near]) == 0
    assert main([str(source), str(out), *near]) == 2
    assert "exists; give --force" in capsys.readouterr().err
