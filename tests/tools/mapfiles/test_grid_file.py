"""Grids that ``triquad-pack`` writes, read with numpy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.maps.exact_maps import exact_map, table
from support.maps.map_records import random_record
from triquad_client import OfflineMap, Status
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.crop import crop_record

FAR = (450_000.0, 5_400_000.0, 400.0)
CORNERS = np.array([[-3.0, -2.5, -0.5], [3.3, 1.5, 2.0]])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "far.triquad"
    write_map(replace(exact_map(table(0.1, 1.1)), origin_m=FAR), path, feature_dtype="<f4")
    return path


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def test_a_grid_has_what_the_map_answers_at_its_cells(path: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "grid.npz"
    box = ["--crop", *map(str, np.add(CORNERS, FAR).ravel())]
    assert main([str(path), str(out), *box, "--cell", "0.15"]) == 0
    assert "42 x 27 x 17 cells of 0.15 m" in capsys.readouterr().out
    found = arrays(out)
    assert found["distance_m"].shape == found["status"].shape == (42, 27, 17)
    assert "".join(found["axes"]) == "xyz"
    assert found["cell_m"] == 0.15
    np.testing.assert_allclose(found["corner"], CORNERS[0] + FAR, atol=1e-6)
    cells = np.stack(np.indices(found["status"].shape), axis=-1).reshape(-1, 3)
    middles = found["corner"] + (cells + 0.5) * found["cell_m"]
    whole = replace(exact_map(table(0.1, 1.1)), origin_m=FAR)
    with OfflineMap(whole) as opened:  # what was left out for the box changes no answer
        answer = opened.query_distance(middles, float(found["max_distance_m"]))
    np.testing.assert_array_equal(found["status"].reshape(-1), answer.status)
    np.testing.assert_allclose(found["distance_m"].reshape(-1), answer.distance_m, atol=1e-4)
    assert set(found["status"].ravel().tolist()) == set(map(int, Status))


def test_without_a_box_all_seen_surface_is_in_it(path: Path, tmp_path: Path) -> None:
    assert main([str(path), str(tmp_path / "grid.npz")]) == 0
    found = arrays(tmp_path / "grid.npz")
    assert found["cell_m"] == 0.2
    np.testing.assert_allclose(found["corner"], np.add(FAR, [-10, -10, 0]), atol=1e-6)
    assert found["status"].shape == (100, 100, 6)


def test_what_is_refused(path: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "grid.npz"
    assert main([str(path), str(out), "--cell", "0.01"]) == 2
    told = capsys.readouterr().err
    assert "would have 2,000 x 2,000 x 120 cells of 0.01 m, more than 100,000,000" in told
    assert "use --crop, or a larger --cell" in told
    empty = tmp_path / "empty.triquad"
    write_map(crop_record(random_record(1), [7.9] * 3, [7.95] * 3), empty)
    assert main([str(empty), str(out)]) == 1
    assert "no surface was seen" in capsys.readouterr().err
    assert not out.exists()
