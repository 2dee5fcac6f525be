import threading

from support import servers
from triquad_server.intake import scan_queue, source_ledger
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.source_ledger import SourceLedger

SCAN = servers.scan()
SOURCE = (SCAN.source, SCAN.session)


def arrive_and_take(ledger, sequence):
    assert ledger.arrive(servers.scan(sequence)) is None
    ledger.take(servers.scan(sequence))


def test_a_taken_scan_is_settled_at_once_but_done_only_when_published():
    ledger = SourceLedger()
    assert ledger.arrive(SCAN) is None
    assert not ledger.is_settled(*SOURCE, 0)
    ledger.take(SCAN)
    assert ledger.is_settled(*SOURCE, 0)
    assert not ledger.outcome(*SOURCE, 0).done
    ledger.publish()
    reply = ledger.outcome(*SOURCE, 0)
    assert (reply.taken, reply.refused, reply.lost) == (1, 0, 0)


def test_gaps_count_as_lost_also_before_the_first_scan():
    ledger = SourceLedger()
    arrive_and_take(ledger, 3)
    arrive_and_take(ledger, 5)
    ledger.publish()
    reply = ledger.outcome(*SOURCE, 5)
    assert (reply.taken, reply.lost) == (2, 4)
    assert ledger.lost() == {"lidar": 4}


def test_a_scan_is_not_settled_while_an_earlier_one_waits():
    ledger = SourceLedger()
    ledger.arrive(servers.scan(0))
    ledger.arrive(servers.scan(1))
    ledger.arrive(servers.scan(2, stamp_ns=0))
    ledger.refuse(servers.scan(1), "no points")
    assert not ledger.is_settled(*SOURCE, 1)
    assert not ledger.outcome(*SOURCE, 1).done, "the first still waits"
    ledger.take(servers.scan(0))
    assert ledger.is_settled(*SOURCE, 2)
    ledger.publish()
    reply = ledger.outcome(*SOURCE, 1)
    assert (reply.done, reply.taken, reply.refused, reply.lost) == (True, 1, 2, 0)
    assert reply.last_refusal == "scan 1: no points"


def test_later_scans_do_not_hold_up_a_published_one():
    ledger = SourceLedger()
    arrive_and_take(ledger, 0)
    ledger.publish()
    arrive_and_take(ledger, 1)
    assert ledger.outcome(*SOURCE, 0).done
    assert not ledger.outcome(*SOURCE, 1).done


def test_time_that_runs_backwards_is_refused_per_session():
    ledger = SourceLedger()
    arrive_and_take(ledger, 0)
    assert ledger.arrive(servers.scan(1, stamp_ns=999)) == "time_backwards"
    assert ledger.arrive(servers.scan(2, stamp_ns=1000)) is None
    assert ledger.arrive(servers.scan(0, stamp_ns=1, session=8)) is None


def test_a_clock_that_was_far_ahead_or_is_set_back_costs_one_scan():
    ledger = SourceLedger()
    arrive_and_take(ledger, 0)
    assert ledger.arrive(servers.scan(1, stamp_ns=2**62)) is None
    assert ledger.arrive(servers.scan(2)) == "time_backwards"
    assert ledger.arrive(servers.scan(3)) is None


def test_a_leap_that_no_loss_explains_changes_nothing_for_the_scans_that_follow():
    ledger = SourceLedger()
    arrive_and_take(ledger, 0)
    assert ledger.arrive(servers.scan(2**40)) == "sequence_ahead"
    assert ledger.arrive(servers.scan(900)) is None
    assert ledger.lost() == {"lidar": 899}


def test_a_question_about_a_far_sequence_changes_nothing_for_the_scans_that_follow():
    ledger = SourceLedger()
    arrive_and_take(ledger, 0)
    ledger.publish()
    assert not ledger.outcome(*SOURCE, 2**40).done
    assert ledger.outcome(*SOURCE, 2**40, overdue=True).lost == 2**40
    assert ledger.arrive(servers.scan(900)) is None
    assert ledger.lost() == {"lidar": 899}


def test_sequences_out_of_range_or_order_are_refused_and_change_nothing():
    ledger = SourceLedger()
    for sequence in (-1, 2**48, 2**63 - 1):
        assert ledger.arrive(servers.scan(sequence, stamp_ns=0)) == "bad_sequence"
    arrive_and_take(ledger, 4)
    assert ledger.arrive(servers.scan(4)) == "sequence_backwards"
    assert ledger.arrive(servers.scan(2)) == "sequence_backwards"
    ledger.publish()
    reply = ledger.outcome(*SOURCE, 4)
    assert (reply.taken, reply.refused, reply.lost) == (1, 0, 4)


def test_sessions_remembered_are_bounded(monkeypatch):
    monkeypatch.setattr(source_ledger, "MAX_SESSIONS", 3)
    ledger = SourceLedger()
    for session in range(10):
        ledger.arrive(servers.scan(1, session=session))
    assert ledger.lost() == {"lidar": 3}
    assert not ledger.outcome("lidar", 0, 1).done


def test_losses_of_a_hostile_publisher_still_fit_a_message(monkeypatch):
    monkeypatch.setattr(source_ledger, "MAX_SEQUENCE", 2**60)  # so that few sessions do
    ledger = SourceLedger()
    for session in range(100):
        ledger.arrive(servers.scan(2**60 - 1, session=session))
    assert max(ledger.lost().values()) > 2**60
    assert sum(ledger.lost().values()) <= 2 * (2**63 - 1)
    assert max(ledger.lost().values()) < 2**63


def test_the_sessions_of_a_source_are_counted_together():
    ledger = SourceLedger()
    for session, source in enumerate(["front", "rear", "front"]):
        scan = servers.scan(3, source=source, session=session)
        ledger.arrive(scan)
        ledger.take(scan)
    sources = ledger.metrics()
    assert set(sources) == {"front", "rear"}
    front, rear = sources["front"], sources["rear"]
    assert (front.sessions, front.taken, front.lost) == (2, 2, 6)
    assert (rear.sessions, rear.taken, rear.lost) == (1, 1, 3)
    assert 0 <= front.age_s <= rear.age_s


def test_a_full_queue_pushes_out_the_oldest_scan_and_counts_it():
    queue = ScanQueue(2)
    ledger = queue.ledger
    for sequence in range(3):
        queue.put(servers.scan(sequence))
    assert ledger.lost() == {"lidar": 1}
    assert ledger.is_settled(*SOURCE, 0)
    assert queue.take().sequence == 1
    assert len(queue) == 2  # the one in hand is not in the map yet
    assert queue.take().sequence == 2
    assert queue.take() is None
    assert len(queue) == 0


def test_sources_take_turns_and_the_busiest_loses_alone():
    queue = ScanQueue(2)
    for sequence in range(9):
        queue.put(servers.scan(sequence, source="busy"))
    queue.put(servers.scan(0))
    queue.put(servers.scan(1))
    order = [(scan.source, scan.sequence) for scan in iter(queue.take, None)]
    assert order == [("busy", 7), ("lidar", 0), ("busy", 8), ("lidar", 1)]
    assert queue.ledger.lost() == {"busy": 7}


def test_a_source_is_passed_over_until_it_falls_behind():
    queue = ScanQueue(8)
    for sequence in range(6):
        queue.put(servers.scan(sequence))
    taken = [queue.take({"lidar"}).sequence, queue.take({"lidar"}).sequence]
    assert taken == [0, 1]
    assert queue.take({"lidar"}) is None
    assert queue.take().sequence == 2


def test_questions_give_way_while_a_source_is_about_to_lose_scans(monkeypatch):
    monkeypatch.setattr(scan_queue, "_GIVE_WAY_S", servers.WAIT_S)
    queue = ScanQueue(limit=16)
    for sequence in range(8):
        queue.put(servers.scan(sequence))
    queue.give_way()  # returns at once
    queue.put(servers.scan(8))
    waiting = threading.Thread(target=queue.give_way)
    waiting.start()
    waiting.join(0.1)
    assert waiting.is_alive()
    queue.take()
    waiting.join(servers.WAIT_S)
    assert not waiting.is_alive()


def test_questions_do_not_give_way_to_a_source_whose_scans_never_wait_long(monkeypatch):
    monkeypatch.setattr(scan_queue, "_GIVE_WAY_S", 10 * servers.WAIT_S)
    queue = ScanQueue(limit=4)
    for sequence in range(100):
        queue.put(servers.scan(sequence))
    waiting = threading.Thread(target=queue.give_way, args=(10 * servers.WAIT_S,), daemon=True)
    waiting.start()
    waiting.join(servers.WAIT_S)
    assert not waiting.is_alive()


def test_questions_give_way_to_scans_that_nobody_takes_for_a_moment_only():
    queue = ScanQueue(limit=1)
    queue.put(servers.scan(0))
    waiting = threading.Thread(target=queue.give_way, daemon=True)
    waiting.start()
    waiting.join(servers.WAIT_S)
    assert not waiting.is_alive()


def test_scans_that_wait_are_bounded_in_bytes_over_all_sources():
    nbytes = servers.scan().points.nbytes
    queue = ScanQueue(100, 10 * nbytes)
    queue.put(servers.scan(0))
    for sequence in range(50):
        queue.put(servers.scan(sequence, source="busy"))
    assert queue._scans.nbytes <= 10 * nbytes
    assert queue.ledger.lost().keys() == {"busy"}
    assert queue.take().source == "lidar"


def test_invented_sources_push_out_each_other_first(monkeypatch):
    monkeypatch.setattr(scan_queue, "MAX_SOURCES_WAITING", 2)
    queue = ScanQueue(2)
    queue.put(servers.scan(0))
    for number in range(20):
        queue.put(servers.scan(0, source=f"invented-{number}"))
    assert len(queue) == 4
    assert "lidar" not in queue.ledger.lost()
