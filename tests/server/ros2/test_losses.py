"""What is lost is counted, each of it, and said in the log, but not each of it."""

import pytest
import zenoh
from triquad_server.counter import Counter
from triquad_server.ros2.intake.feeds import Role
from triquad_server.ros2.intake.inbox import Arrival, Inbox, LaneLimit
from triquad_server.ros2.intake.losses import LOG_PERIOD_S, Losses


def test_the_log_has_the_first_and_then_a_line_in_a_while(
    caplog: pytest.LogCaptureFixture,
) -> None:
    counter, now_s = Counter(), 100.0
    losses = Losses(counter, clock=lambda: now_s)
    for _ in range(50):
        losses.add("/points", "pose_late", "too late")
    losses.add("/points", "decode", "no cloud")
    assert [record.message.split(" (")[0] for record in caplog.records] == [
        "ros2: /points: 1 lost, pose_late: too late",
        "ros2: /points: 1 lost, decode: no cloud",
    ]
    now_s += LOG_PERIOD_S
    losses.add("/points", "pose_late", "too late")
    assert "/points: 50 lost, pose_late" in caplog.records[-1].message
    assert "raise ros2.waiting_s" in caplog.records[-1].message
    assert counter.counts() == {"pose_late": 51, "decode": 1}


def test_topics_without_end_take_no_memory_without_end() -> None:
    counter = Counter()
    losses = Losses(counter)
    for number in range(3000):
        losses.add(f"/{number}", "decode", "no cloud")
    assert counter.counts() == {"decode": 3000}
    assert len(losses._kinds) == 1000


def arrival(name: str, role: Role = Role.CLOUD, size: int = 10) -> Arrival:
    return Arrival(role, name, zenoh.ZBytes(bytes(size)), 0)


def test_the_newest_messages_wait_within_limits_and_transforms_come_first() -> None:
    gone: list[str] = []
    inbox = Inbox(
        LaneLimit(messages=3, bytes=100),
        LaneLimit(messages=2, bytes=1000),
        lambda message: gone.append(message.topic_name),
    )
    for name in "abcd":
        inbox.put(arrival(name))
    assert gone == ["a"], "more messages than may wait"
    inbox.put(arrival("large", size=90))
    assert gone == ["a", "b", "c"], "more bytes than may wait"
    inbox.put(arrival("tf", Role.TF))
    taken = [inbox.take(0.0) for _ in range(4)]
    assert [each and each.topic_name for each in taken] == ["tf", "d", "large", None]
    inbox.put(arrival("late"))
    inbox.close()
    assert inbox.take(10.0) is None
