"""The options of ``triquad-ros2`` and its file of settings."""

from pathlib import Path

import pytest
from support import servers
from triquad_tools.commands import ros2
from triquad_tools.commands.ros2 import bridge_options
from triquad_tools.console.command import BAD_INPUT, FAILED, ToolError


def of_file(folder: Path, text: str, *arguments: str) -> list[str]:
    file = folder / "ros2.toml"
    file.write_text(text)
    return ["--settings", str(file), *arguments]


def test_settings_of_a_file_are_options_and_the_command_line_goes_before(tmp_path: Path) -> None:
    text = 'clouds = ["/a", "/b"]\nmap_frame = "/odom"\ngrid_height_m = -1.5\ndepth_stride = 4\n'
    found = bridge_options(ros2.parsed(of_file(tmp_path, text, "--depth-stride", "8")))
    assert found.topics.clouds == ("/a", "/b")
    assert (found.scans.map_frame, found.scans.depth_stride) == ("odom", 8)
    assert found.grid.height_m == -1.5


def test_the_domain_is_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert bridge_options(ros2.parsed([])).topics.domain == 42
    assert bridge_options(ros2.parsed(["--domain", "7"])).topics.domain == 7


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("colour = 3\n", "colour is no setting"),
        ('serve = ["x"]\n', "serve is no setting"),
        ("clouds = [\n", "ros2.toml: "),
    ],
)
def test_a_file_with_other_things_in_it_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ToolError, match=reason):
        ros2.parsed(of_file(tmp_path, text))


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--clouds", "/a b"], "'/a b' is not the name of a topic"),
        (["--domain", "233"], "'233' is not a whole number: use 0 to 232"),
        (["--wait-s", "soon"], "'soon' is not a number"),
        (["--grid-cell-m", "0.001"], "'0.001' is not a number in range: use 0.01 to 10"),
        (["--mesh-bytes-per-s", "5"], "'5' is not a whole number: use 1000 to"),
    ],
)
def test_wrong_options_are_refused_with_the_value(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        ros2.main(arguments)
    assert reason in capsys.readouterr().err


def test_what_cannot_work_ends_with_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    assert ros2.main(["--grid-side-m", "1000"]) == BAD_INPUT
    assert "10000 cells of 0.1 m along each side: use at most 500" in capsys.readouterr().err
    nobody = servers.free_endpoint()
    assert ros2.main(["--connect", nobody]) == FAILED
    assert "nothing listens" in capsys.readouterr().err
    with servers.running_service() as endpoint:
        assert ros2.main(["--connect", endpoint, "--router", nobody]) == BAD_INPUT
    assert "the router of the ROS nodes" in capsys.readouterr().err


def test_a_server_that_does_not_start_ends_the_command_with_its_exit_code() -> None:
    assert ros2.main(["--serve", "--preset", "moon"]) == 2
