"""What is dropped is counted, each of it, and told in the log, but not each of it."""

import pytest
import zenoh
from triquad_tools.ros2.intake.drop_log import LOG_PERIOD_S, DropLog
from triquad_tools.ros2.intake.message_queue import Arrival, MessageQueue
from triquad_tools.ros2.topic_choice import Role


def test_the_log_has_the_first_and_then_a_line_in_a_while(
    caplog: pytest.LogCaptureFixture,
) -> None:
    now_s = 100.0
    drops = DropLog(clock=lambda: now_s)
    for _ in range(50):
        drops.add("/points", "pose_late", "too late")
    drops.add("/points", "decode", "no cloud")
    assert [record.message.split(" (")[0] for record in caplog.records] == [
        "/points: 1 dropped, pose_late: too late",
        "/points: 1 dropped, decode: no cloud",
    ]
    now_s += LOG_PERIOD_S
    drops.add("/points", "pose_late", "too late")
    assert "/points: 50 dropped, pose_late" in caplog.records[-1].message
    assert "raise --wait-s" in caplog.records[-1].message
    assert drops.counts() == {"pose_late": 51, "decode": 1}


def test_topics_without_end_take_no_memory_without_end() -> None:
    drops = DropLog()
    for number in range(3000):
        drops.add(f"/{number}", "decode", "no cloud")
    assert drops.counts() == {"decode": 3000}
    assert len(drops._logged_s) == 1000


def arrival(name: str, role: Role = Role.CLOUD, size: int = 10) -> Arrival:
    return Arrival(role, name, zenoh.ZBytes(bytes(size)), 0)


def test_the_newest_messages_wait_within_limits_and_transforms_stay() -> None:
    dropped: list[str] = []
    messages = MessageQueue(3, 10_100, lambda message: dropped.append(message.topic_name))
    messages.put(arrival("tf", Role.TF))
    for name in "abcd":
        messages.put(arrival(name))
    assert dropped == ["a"], "more scans than may wait"
    messages.put(arrival("large", size=7_000))
    assert dropped == ["a", "b", "c"], "more bytes than may wait"
    taken = [messages.take(0.0) for _ in range(4)]
    assert [each and each.topic_name for each in taken] == ["tf", "d", "large", None]
    messages.put(arrival("late"))
    messages.close()
    assert messages.take(10.0) is None
