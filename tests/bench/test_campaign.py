"""Each part of the campaign for a moment, and the campaign itself: it counts and goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.campaign.all_parts import BY_NAME, PARTS
from bench.campaign.campaign import Campaign
from bench.campaign.turn import Part, Turn

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
_PLENTY_S = 240.0  # the number of things ends a turn, however slow the machine
_FEW = {
    "messages": 300,
    "files": 40,
    "kills": 1,
    "busy": 1,
    "disk": 4,
    "clock": 2,
    "cuts": 3,
    "stops": 1,
    "memory": 1,
    "crowd": 10,
    "driving": 2,
}


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_nothing_breaks_in_a_short_turn(part: Part, tmp_path: Path) -> None:
    if why := part.missing():
        pytest.skip(why)
    turn = Turn(seed=1, folder=tmp_path, most=_FEW[part.name], seconds=_PLENTY_S)
    part.run(turn)
    assert turn.broken == []
    assert turn.counts["done"] >= 1


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    counts = []
    for _ in range(2):
        campaign = Campaign(tmp_path, [BY_NAME["files"]])
        campaign.run(seconds=2.0)
        assert campaign.broken == 0
        counts.append(int(campaign.table().splitlines()[2].split()[3].replace(",", "")))
    assert 0 < counts[0] < counts[1]


def test_ctrl_c_ends_all_turns_and_keeps_what_was_done(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bench.campaign", "--part", "driving", "--out", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'tests'}:{ROOT}"}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.glob("driving-1.log")):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        table, _ = process.communicate(timeout=30)
    assert "0 turns, 0 promises broken" in table
    assert not list(tmp_path.glob("*.json"))


def test_a_part_whose_process_ends_is_told_as_broken(tmp_path: Path) -> None:
    unknown = Part("unknown", "things", time.sleep, 1, 1)  # type: ignore[arg-type]
    campaign = Campaign(tmp_path, [unknown])
    campaign.run(seconds=1.0)
    assert campaign.broken >= 1
    assert "ended with 2" in (tmp_path / "unknown-1.json").read_text()
