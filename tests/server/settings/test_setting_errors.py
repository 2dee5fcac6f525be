"""What is wrong with a setting is told with its place, its value and what may stand there."""

from pathlib import Path

import pytest
from triquad_format.errors import SettingsError
from triquad_server.settings.loading import load_settings


@pytest.mark.parametrize(
    ("variable", "words"),
    [
        ("TRIQUAD_TRIANING__BATCH", ["unknown setting trianing: did you mean training?"]),
        ("TRIQUAD_TRAINING__BATCH", ["training.batch = 0.5", "integer"]),
        ("TRIQUAD_STORE", ["store = 0.5", "[store]"]),
        ("TRIQUAD_SOURCES__ROOF__RANGE_MX_M", ["did you mean sources.roof.range_max_m?"]),
        ("TRIQUAD_SOURCES", ["sources = 0.5", "[sources.NAME]"]),
        ("TRIQUAD_SCAN_RANGE_MIN_M", ["RANGE_MIN_M is no setting", "TRIQUAD_SCAN__RANGE_MIN_M?"]),
    ],
)
def test_errors_name_the_environment(
    monkeypatch: pytest.MonkeyPatch, variable: str, words: list[str]
) -> None:
    monkeypatch.setenv(variable, "0.5")
    with pytest.raises(SettingsError) as error:
        load_settings()
    assert all(word in str(error.value) for word in ["environment", *words])


def test_errors_of_a_source_name_the_place_of_that_key(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[sources.roof]\nrange_max_m = '9'\nrobot_box_m = [[0, 0, 0], [1, 1, 99]]\n")
    with pytest.raises(SettingsError) as error:
        load_settings(path, ["sources.roof.no_return=false", "sources.roof.range_min_m=-1"])
    wrong = str(error.value).split("; ")
    assert [text.partition(" = ")[0] for text in wrong] == [
        "--set: sources.roof.range_min_m",
        f"settings file {path}: sources.roof.range_max_m",
        f"settings file {path}: sources.roof.robot_box_m.1.2",
    ]


@pytest.mark.parametrize(
    ("assignments", "words"),
    [
        (
            "training.bacth=1",
            ["--set", "unknown setting training.bacth: did you mean training.batch?"],
        ),
        ("training.batch", ["--set", "training.batch", "SECTION.KEY=VALUE"]),
        ("batch=4096", ["batch=4096", "SECTION.KEY=VALUE"]),
        ("sources.roof=1", ["sources.roof=1", "sources.NAME.KEY=VALUE"]),
        ("sources.roof.range_max_m=far", ["--set", "range_max_m = 'far'", "a valid number"]),
        ("scan.range_min_m=nan", ["scan.range_min_m = nan", "a finite number"]),
        ("scan.range_min_m=inf", ["scan.range_min_m = inf", "a finite number"]),
        ("training.batch=nan", ["--set: training.batch = nan", "a valid integer"]),
        ("scan.thin_m=0", ["--set", "scan.thin_m = 0: ", "or equal to 0.001"]),
        ("change.static=maybe", ["--set", "change.static = 'maybe'", "a valid boolean"]),
        ("sources.ro of.range_max_m=9", ["'ro of'", "letters"]),
        ("sources.roof.range_max_m=1", ["--set", "roof.range_max_m = 1", "range_min_m = 1.5"]),
        ("sources.roof.range_max_m=9000", ["sources.roof.range_max_m", "leaf_m"]),
        ("sources.roof.robot_box_m=[[0, 0, 0], [1, 0, 1]]", ["robot_box_m", "smaller x"]),
        (
            "sources.roof.robot_box_m=[[-9, -9, -9], [9, 9, 9]]",
            ["robot_box_m", "100000 voxels", "smaller box"],
        ),
        (
            "field.leaf_m=0.01;field.depth=6;scan.range_max_m=5.0",
            ["--set: scan.range_max_m = 5 reaches", "leaf_m = 0.01", "depth", "at most 3.84"],
        ),
        ("scan.thin_m=0.001;scan.range_max_m=1500.0", ["thin_m", "range_max_m"]),
        ("field.leaf_m=0.05;mesh.cell_m=0.5", ["cell_m", "leaf_m"]),
    ],
)
def test_errors_name_the_command_line(assignments: str, words: list[str]) -> None:
    """Those of single settings, and of some that do not go together."""
    with pytest.raises(SettingsError) as error:
        load_settings(assignments=assignments.split(";"))
    assert "quotes" not in str(error.value)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[field]\nleaf = 0.3\n", ["leaf", "leaf_m"]),
        ("[filed]\nleaf_m = 0.3\n", ["filed", "field"]),
        ("[field]\nleaf_m = 'big'\n", ["field.leaf_m", "big", "number"]),
        ("[field]\ndepth = true\n", ["field.depth", "True"]),
        ("[field]\nencoding = 'all'\n", ["encoding", "all", "both"]),
        ("[training]\nbatch = 2.0\n", ["training.batch = 2.0", "integer"]),
        ("[scan]\nspread_m = '0.1'\n", ["spread_m = '0.1'", "a valid number"]),
        ("[training]\nbatch = 0\nseed = -1\n", ["training.batch = 0", "training.seed = -1"]),
        ("[scan]\nrange_max_m = 1\n", ["range_max_m = 1", "range_min_m = 1.5"]),
        ("field = 3\n", ["field", "3"]),
        ("sources = 3\n", ["sources = 3", "[sources.NAME]"]),
        ("[source.roof]\nrange_max_m = 9\n", ["unknown setting source: did you mean"]),
        (
            "[sources.roof]\nrange_max_m = 9\n[Sources.roof]\nrange_min_m = 2\n",
            ["unknown setting Sources: did you mean sources?"],
        ),
        (
            "[sources.front.left]\nrange_max_m = 9\n",
            ["sources.front.left", "quotes", '[sources."a.b"]'],
        ),
        ("[sources.roof]\nrobot_box = 3\n", ["did you mean sources.roof.robot_box_m?"]),
        ("[sources.roof]\nrobot_box_m = 3\n", ["robot_box_m = 3: write two corners, [[x, y, z]"]),
        ("[sources.a]\nrobot_box_m = [[0, 0, 0], [1, 1, 99]]\n", ["99", "or equal to 20"]),
        ("range_min_m = 1\n", ["unknown setting range_min_m: did you mean scan.range_min_m?"]),
        ("[SCAN]\nrange_min_m = 1\n", ["unknown setting SCAN: did you mean scan?"]),
        ("[nix]\na = 1\n", ["unknown setting nix: triquad-server --print-settings has all"]),
        ("[field\n", ["settings.toml"]),
        (f"[field]\nleaf_m = 1{'0' * 400}\n", ["leaf_m", "number"]),
        (f"[field]\ndepth = 1{'0' * 5000}\n", ["settings.toml"]),
        (f"a = {'[' * 5000}\n", ["settings.toml"]),
    ],
)
def test_errors_name_the_key_and_the_value(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        load_settings(path)
    assert all(word in str(error.value) for word in [*words, str(path)])
