"""What is dropped is counted, each of it, and told in the log, but not each of it."""

import pytest
import zenoh
from triquad_tools.ros2.intake.drop_log import LOG_PERIOD_S, DropLog
from triquad_tools.ros2.intake.topic_listener import Arrival, Limits, MessageQueue
from triquad_tools.ros2.options import Role


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


def taken(messages: MessageQueue) -> list[str]:
    return [each.topic_name for each in iter(lambda: messages.take(0.0), None)]


def test_the_newest_messages_wait_within_limits() -> None:
    dropped: list[str] = []
    limits = Limits(3, 10_000), Limits(2, 5_000)
    messages = MessageQueue(*limits, lambda message: dropped.append(message.topic_name))
    for name in "abcd":
        messages.put(arrival(name))
    assert dropped == ["a"], "more scans than may wait"
    messages.put(arrival("large", size=7_000))
    assert dropped == ["a", "b", "c"], "more bytes than may wait"
    assert taken(messages) == ["d", "large"]
    messages.put(arrival("late"))
    messages.close()
    assert messages.take(10.0) is None


def test_transforms_go_before_scans_and_push_out_none() -> None:
    dropped: list[str] = []
    limits = Limits(3, 10_000), Limits(2, 5_000)
    messages = MessageQueue(*limits, lambda message: dropped.append(message.topic_name))
    messages.put(arrival("cloud", size=8_000))
    for name in ("tf1", "tf2", "tf3"):
        messages.put(arrival(name, Role.TF))
    assert dropped == ["tf1"], "more messages than may wait"
    messages.put(arrival("tf4", Role.TF, size=3_900))
    assert dropped == ["tf1", "tf2", "tf3"], "more bytes than may wait"
    assert taken(messages) == ["tf4", "cloud"]
