import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import servers
from triquad_format.errors import SettingsError
from triquad_format.records.field_settings import FieldSettings
from triquad_server import cli
from triquad_server.settings import MeshSettings, Settings, SourceSettings
from triquad_server.settings.loading import PRESETS, load_settings, settings_toml
from triquad_server.settings.settings import setting_schemas

ROOT = Path(__file__).parents[3]


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[field]\nleaf_m = 0.3\n[mesh]\ncell_m = 1\n")
    settings = load_settings(path)
    assert settings.field.leaf_m == 0.3
    assert settings.mesh.cell_m == 1.0
    assert settings.training == Settings().training


def test_the_environment_goes_before_the_file_and_the_command_line_before_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[training]\nbatch = 1\nseed = 1\nmax_regions = 1\n")
    monkeypatch.setenv("TRIQUAD_TRAINING__BATCH", "2")
    monkeypatch.setenv("TRIQUAD_TRAINING__SEED", "2")
    training = load_settings(path, ["training.batch=3"]).training
    assert (training.batch, training.seed, training.max_regions) == (3, 2, 1)


def test_a_file_has_numbers_and_text_stands_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[training]\nlearning_rate = 1\n")
    monkeypatch.setenv("TRIQUAD_FIELD__LEAF_M", "1")
    monkeypatch.setenv("TRIQUAD_CHANGE__STATIC", "true")
    settings = load_settings(path, ["scan.max_points=4096", "scan.spread_m=1e-1"])
    assert settings.change.static
    assert not load_settings(assignments=["change.static=false"]).change.static
    assert settings.training.learning_rate == 1.0
    assert settings.field.leaf_m == 1.0
    assert (settings.scan.max_points, settings.scan.spread_m) == (4096, 0.1)


def test_a_preset_lies_below_all_else(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[training]\nbatch = 1\n[scan]\nthin_m = 0.03\n")
    settings = load_settings(path, ["training.seed=3"], preset="indoor")
    indoor = load_settings(preset="indoor")
    assert indoor.field.leaf_m < Settings().field.leaf_m
    assert settings.field == indoor.field
    assert (settings.training.batch, settings.training.seed) == (1, 3)
    assert (settings.scan.thin_m, settings.scan.spread_m) == (0.03, indoor.scan.spread_m)


def test_the_street_is_what_there_is_without_a_preset() -> None:
    assert load_settings(preset="street") == Settings()


def test_presets_are_all_that_lie_in_their_folder_and_each_is_valid() -> None:
    folder = ROOT / "server" / "triquad_server" / "settings" / "presets"
    assert {path.stem for path in folder.iterdir()} == set(PRESETS)
    leaves = {name: load_settings(preset=name).field.leaf_m for name in PRESETS}
    assert leaves["tabletop"] < leaves["indoor"] < leaves["street"] < leaves["long-range"]


def test_errors_tell_what_a_preset_gave_and_which_file_is_missing(tmp_path: Path) -> None:
    leaf_m = load_settings(preset="indoor").field.leaf_m
    with pytest.raises(SettingsError, match=f"--set: mesh.cell_m = 2 .*leaf_m = {leaf_m:g}"):
        load_settings(assignments=["mesh.cell_m=2"], preset="indoor")
    told = "there is no preset '../indoor': use street, indoor, tabletop, long-range"
    with pytest.raises(SettingsError, match=told):
        load_settings(preset="../indoor")
    with pytest.raises(SettingsError, match="nowhere.toml"):
        load_settings(tmp_path / "nowhere.toml")


def test_lengths_follow_the_leaf_from_wherever_it_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[field]\nleaf_m = 0.05\n")
    in_python = Settings(field=FieldSettings(leaf_m=0.05))
    assert load_settings(path) == load_settings(assignments=["field.leaf_m=0.05"]) == in_python
    monkeypatch.setenv("TRIQUAD_FIELD__LEAF_M", ".05")
    assert load_settings() == in_python
    scan, mesh = in_python.scan, in_python.mesh
    assert (scan.range_min_m, scan.range_max_m, scan.thin_m) == (0.375, 12.5, 0.0125)
    assert (scan.spread_m, scan.behind_m) == (0.02, 0.2)
    assert (mesh.cell_m, mesh.reach_m, mesh.tolerance_m) == (0.025, 0.005, 0.0025)


def test_a_length_that_is_given_follows_nothing() -> None:
    settings = load_settings(assignments=["field.leaf_m=0.05", "scan.thin_m=0.02"])
    assert (settings.scan.thin_m, settings.scan.spread_m) == (0.02, 0.02)
    coarse = Settings(field=FieldSettings(leaf_m=0.4), mesh=MeshSettings(cell_m=0.1))
    assert (coarse.mesh.cell_m, coarse.mesh.reach_m) == (0.1, 0.04)


@given(st.floats(0.01, 10.0), st.integers(6, 15))
def test_what_follows_from_any_leaf_is_allowed(leaf_m: float, depth: int) -> None:
    settings = Settings(field=FieldSettings(leaf_m=leaf_m, depth=depth))
    assert Settings.model_validate(settings.model_dump()) == settings
    assert settings.scan.thin_m == pytest.approx(leaf_m / 4)


def test_for_another_field_lengths_follow_its_leaf_and_have_to_go_with_it() -> None:
    settings = load_settings(assignments=["field.leaf_m=0.05", "mesh.cell_m=0.1"])
    street = settings.with_field(FieldSettings())
    assert street.scan == Settings().scan
    assert street.mesh == Settings().mesh
    assert street.with_field(settings.field) == settings
    with pytest.raises(SettingsError, match=r"mesh\.cell_m = 0\.1 .* field\.leaf_m = 0\.02"):
        settings.with_field(FieldSettings(leaf_m=0.02))


def test_errors_tell_lengths_that_follow_from_those_that_are_given() -> None:
    with pytest.raises(SettingsError) as error:
        load_settings(assignments=["field.leaf_m=1", "scan.range_max_m=5"])
    assert str(error.value) == (
        "--set: scan.range_max_m = 5 is less than scan.range_min_m = 7.5 "
        "(which follows field.leaf_m = 1): use at least that"
    )


def test_printed_settings_mark_the_lengths_that_follow_the_leaf() -> None:
    printed = settings_toml(load_settings(assignments=["field.leaf_m=0.1", "scan.thin_m=0.02"]))
    assert "\nspread_m = 0.04  # follows field.leaf_m\n" in printed
    assert "\nthin_m = 0.02\n" in printed


def test_sources_have_sections_of_their_own_from_all_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(
        "[sources.roof]\nrange_max_m = 30\nrange_min_m = 2\n"
        '[sources."front.left"]\nrobot_box_m = [[-1, -0.5, -1], [0.5, 0.5, 0]]\n'
    )
    monkeypatch.setenv("TRIQUAD_SOURCES__ROOF__RANGE_MAX_M", "40")
    monkeypatch.setenv("TRIQUAD_SOURCES__REAR__ROBOT_BOX_M", "[[0, 0, 0], [1, 1, 1]]")
    settings = load_settings(
        path, ["sources.roof.no_return=false", "sources.front.left.range_min_m=0.2"]
    )
    box = ((-1.0, -0.5, -1.0), (0.5, 0.5, 0.0))
    assert settings.sources == {
        "roof": SourceSettings(range_max_m=40.0, range_min_m=2.0, no_return=False),
        "front.left": SourceSettings(range_min_m=0.2, robot_box_m=box),
        "rear": SourceSettings(robot_box_m=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))),
    }
    of_left = settings.scan_of(settings.sources["front.left"])
    assert (of_left.range_min_m, of_left.range_max_m) == (0.2, settings.scan.range_max_m)
    assert of_left.thin_m == settings.scan.thin_m


def test_settings_that_are_printed_can_be_read(tmp_path: Path) -> None:
    settings = load_settings(
        assignments=[
            "field.encoding=fourier",
            "scan.thin_m=0.001",
            "mesh.reach_m=1e-5",
            "sources.roof.left.range_max_m=20",
            "sources.roof.no_return=false",
            "sources.roof.robot_box_m=[[-1, -1, -1], [1, 1, 1]]",
        ]
    )
    path = tmp_path / "settings.toml"
    path.write_text(settings_toml(settings))
    assert load_settings(path) == settings


def test_the_command_prints_the_settings_in_effect() -> None:
    line = [sys.executable, "-m", "triquad_server.cli", "--print-settings"]
    line += ["--set", "training.batch=4096"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=servers.WAIT_S)
    assert (done.returncode, done.stderr) == (cli.OK, "")
    assert "[training]\nbatch = 4096\n" in done.stdout


def test_every_setting_is_read_somewhere() -> None:
    code = "".join(
        path.read_text()
        for folder in ("server", "format")
        for path in (ROOT / folder).rglob("*.py")
        if path.name not in ("settings.py",)
    )
    for section, schemas in setting_schemas().items():
        for key in schemas:
            assert re.search(rf"\.{key}\b", code), f"{section}.{key} is unread"


@pytest.mark.parametrize(
    ("name", "script"), [("settings.md", "settings_tables.py"), ("numbers.md", "numbers_table.py")]
)
def test_the_page_is_the_one_that_the_code_makes(name: str, script: str) -> None:
    page = (ROOT / "docs" / name).read_text()
    with_tables = runpy.run_path(str(ROOT / "docs" / script))["with_tables"]
    assert with_tables(page) == page, "run `make docs`"
