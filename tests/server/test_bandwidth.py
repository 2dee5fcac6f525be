import pytest
from triquad_server.mesh.followers import MAX_CLIENTS, Bandwidth


def sent(bandwidth: Bandwidth, rate: float, reply: int, seconds: float) -> float:
    """Bytes a second that a client gets who asks every millisecond."""
    total = 0
    for step in range(int(1000 * seconds)):
        if bandwidth.may_send("robot", rate, step / 1000):
            bandwidth.spend("robot", reply, rate, step / 1000)
            total += reply
    return total / seconds


@pytest.mark.parametrize("reply", [10, 1_000, 5_000])
def test_a_client_gets_what_it_may_have(reply: int) -> None:
    rate = 1000.0
    assert sent(Bandwidth(), rate, reply, 60.0) == pytest.approx(rate, abs=(rate + reply) / 60)


def test_a_pause_is_worth_a_second_at_most() -> None:
    bandwidth = Bandwidth()
    assert bandwidth.may_send("robot", 1000, 0.0)
    bandwidth.spend("robot", 1000, 1000, 3600.0)
    assert not bandwidth.may_send("robot", 1000, 3600.0)
    assert bandwidth.may_send("robot", 1000, 3600.1)


def test_clients_do_not_share() -> None:
    bandwidth = Bandwidth()
    bandwidth.spend("greedy", 10**9, 1000, 0.0)
    assert not bandwidth.may_send("greedy", 1000, 10.0)
    assert bandwidth.may_send("robot", 1000, 10.0)


def test_of_very_many_clients_those_heard_of_longest_ago_are_forgotten() -> None:
    bandwidth = Bandwidth()
    bandwidth.spend("greedy", 10**9, 1000, 0.0)
    for number in range(MAX_CLIENTS - 1):
        assert bandwidth.may_send(f"client-{number}", 1000, 1.0)
    assert not bandwidth.may_send("greedy", 1000, 2.0)
    for number in range(MAX_CLIENTS):
        assert bandwidth.may_send(f"other-{number}", 1000, 3.0)
    assert bandwidth.may_send("greedy", 1000, 3.0)
