import dataclasses
import re
from pathlib import Path

import pytest
from triquad_format.errors import SettingsError
from triquad_server.settings import Settings, load_settings, parse_settings

ROOT = Path(__file__).parents[2]


def test_the_defaults_of_the_field_are_the_published_ones() -> None:
    field = Settings().field
    assert (field.leaf_m, field.depth, field.feature_levels, field.feature_size) == (0.2, 12, 3, 8)
    assert (field.frequencies, field.frequency_variance, field.hidden) == (16, 50.0, 32)
    assert field.region_side_m == pytest.approx(819.2)
    assert field.input_size == 120


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[field]\nleaf_m = 0.3\n[mesh]\ncell_m = 1\n")
    settings = load_settings(path)
    assert settings.field.leaf_m == 0.3
    assert settings.mesh.cell_m == 1.0
    assert settings.training == Settings().training


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[field]\nleaf = 0.3\n", ["leaf", "leaf_m"]),
        ("[filed]\nleaf_m = 0.3\n", ["filed", "field"]),
        ("[field]\nleaf_m = 'big'\n", ["field.leaf_m", "big", "float"]),
        ("[field]\nleaf_m = -1\n", ["leaf_m", "-1", "0.01"]),
        ("[field]\ndepth = true\n", ["field.depth", "True"]),
        ("[field]\nencoding = 'all'\n", ["encoding", "all", "both"]),
        ("[training]\nbatch = 0\n", ["batch", "0"]),
        ("field = 3\n", ["field", "3"]),
        ("[field\n", ["settings.toml"]),
        ("[scan]\nrange_min_m = nan\n", ["range_min_m", "nan"]),
        ("[training]\nseed = -1\n", ["seed", "-1"]),
        (f"[field]\nleaf_m = 1{'0' * 400}\n", ["leaf_m", "64 bits"]),
        (f"[field]\ndepth = 1{'0' * 400}\n", ["depth", "64 bits"]),
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


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"field": {"leaf_m": 0.01, "depth": 6}}, ["range_max_m", "leaf_m", "depth"]),
        ({"scan": {"thin_m": 0.001, "range_max_m": 2000.0}}, ["thin_m", "range_max_m"]),
        ({"field": {"leaf_m": 0.05}, "mesh": {"cell_m": 0.5}}, ["cell_m", "leaf_m"]),
    ],
)
def test_settings_that_do_not_go_together_are_refused(
    sections: dict[str, dict[str, float]],
    words: list[str],
) -> None:
    with pytest.raises(SettingsError) as error:
        parse_settings(sections)
    assert all(word in str(error.value) for word in words)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="nowhere.toml"):
        load_settings(tmp_path / "nowhere.toml")


def test_every_setting_is_read_somewhere() -> None:
    code = "".join(
        path.read_text()
        for folder in ("server", "format")
        for path in (ROOT / folder).rglob("*.py")
        if path.name not in ("settings.py",)
    )
    for part in dataclasses.fields(Settings):
        for entry in dataclasses.fields(type(getattr(Settings(), part.name))):
            assert re.search(rf"\.{entry.name}\b", code), f"{part.name}.{entry.name} is unread"


def test_parse_takes_nothing_as_defaults() -> None:
    assert parse_settings({}) == Settings()


def test_the_document_lists_every_setting_with_its_default() -> None:
    document = (ROOT / "docs" / "settings.md").read_text()
    for part in dataclasses.fields(Settings):
        section = document.split(f"## `[{part.name}]`")[1].split("\n## ")[0]
        record = getattr(Settings(), part.name)
        for entry in dataclasses.fields(type(record)):
            value = repr(getattr(record, entry.name)).replace("'", '"')
            assert f"| `{entry.name}` | `{value}` |" in section, f"{part.name}.{entry.name}"


def test_an_optimiser_that_would_diverge_is_refused() -> None:
    with pytest.raises(SettingsError, match="beta2 = 0.1 is too small for beta1 = 0.9"):
        parse_settings({"training": {"beta2": 0.1}})
