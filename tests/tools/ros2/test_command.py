"""The options of ``triquad-ros2`` and files of them."""

from pathlib import Path

import pytest
from support import servers
from triquad_tools.commands import ros2
from triquad_tools.commands.ros2 import parser
from triquad_tools.console.command import BAD_INPUT, FAILED
from triquad_tools.work.ros2 import bridge_options


def test_a_file_stands_for_arguments(tmp_path: Path) -> None:
    file = tmp_path / "robot.args"
    file.write_text("--clouds\n/a\n/b\n--map-frame=/odom\n--grid-height-m=-1.5\n--depth-stride=4\n")
    found = bridge_options(parser().parse_args([f"@{file}", "--depth-stride", "8"]))
    assert found.topics.clouds == ("/a", "/b")
    assert (found.map_frame, found.depth_stride) == ("odom", 8)
    assert found.grid.height_m == -1.5


def test_the_domain_is_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert bridge_options(parser().parse_args([])).topics.domain == 42
    assert bridge_options(parser().parse_args(["--domain", "7"])).topics.domain == 7


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--clouds", "/a b"], "'/a b' is not the name of a topic"),
        (["--domain", "233"], "'233' is not a whole number in range: use 0 to 232"),
        (["--wait-s", "soon"], "'soon' is not a number"),
        (["--grid-cell-m", "0.001"], "'0.001' is not a number in range: use 0.01 to 10"),
        (["--mesh-bytes-per-s", "5"], "'5' is not a whole number in range: use 1000 to"),
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
