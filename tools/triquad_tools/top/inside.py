"""What the page tells of the map: how it learns, whether it is kept, and what waits for it."""

from triquad_format.wire.messages import CheckpointInfo, FieldFit, ServerStatus
from triquad_format.wire.metrics_messages import QueueMetrics, ServerMetrics

from triquad_tools.top.amounts import count, duration, rate, size, within
from triquad_tools.top.interval import Interval
from triquad_tools.top.problems import Grade
from triquad_tools.top.section import NONE_YET, Row, Section

_NEARLY_FULL = 0.8  # of a queue
_SCANS = "scans"  # the queue that tells whether the server keeps up


def inside(seen: Interval) -> tuple[Section, ...]:
    """The parts about the map."""
    return (_map(seen), _store(seen), *_queues(seen.sample.metrics))


def _map(seen: Interval) -> Section:
    status, metrics, rates = seen.sample.status, seen.sample.metrics, seen.rates
    age = f", {duration(metrics.epoch_age_s)} old" if metrics else ""
    rows = [
        Row("epoch", (f"{status.epoch:,}{age}",)),
        Row("epochs /s", (rate(rates.epochs) if rates else NONE_YET,)),
        Row("samples /s", (rate(rates.samples_trained) if rates else NONE_YET,)),
        Row("to learn", (_left(status, rates.samples_trained if rates else 0.0),)),
        Row("loss", (f"{status.loss:.4f}",)),
        Row("regions", (count(status.regions),)),
        Row("parameters", (count(status.parameters),)),
        *_kept(status),
        *_fit(status.fit),
    ]
    return Section("MAP", ("",), tuple(rows))


def _kept(status: ServerStatus) -> list[Row]:
    """Whether all rays are kept that are worth it."""
    if status.replay_share >= 1.0:
        return []
    return [Row("rays kept", (f"{100 * status.replay_share:.0f} % of what is wanted",))]


def _fit(fit: FieldFit | None) -> list[Row]:
    """How well the field fits rays that it is not trained on."""
    if fit is None:
        return []
    rows = [Row("held-out rays within", (within(fit.median_m, fit.upper_m),))]
    if fit.repairing:
        rows.append(Row("learnt again", (f"{count(fit.repairing)} places",), Grade.WARNING))
    return rows


def _left(status: ServerStatus, samples_per_s: float) -> str:
    if status.settled:
        return "nothing, settled"
    left = f"{count(status.samples_left)} samples"
    if samples_per_s <= 0.0:
        return left
    return f"{left}, {duration(status.samples_left / samples_per_s)}"


def _store(seen: Interval) -> Section:
    status, metrics = seen.sample.status, seen.sample.metrics
    last, written = status.last_checkpoint, metrics.checkpoints if metrics else None
    # A server that was started without a store says that, too, and nothing is wrong with it.
    had_one = last is not None or bool(written and written.failed)
    bad = Grade.ERROR if had_one and status.store_error is not None else Grade.GOOD
    rows = [Row("last checkpoint", ("none" if last is None else _age(last, seen),), bad)]
    if last is not None:
        rows.append(Row("its epoch, size", (f"{last.epoch:,}, {size(last.bytes)}",)))
    if written is not None and written.last_duration_s is not None:
        rows.append(Row("writing took", (duration(written.last_duration_s),)))
    if written is not None:
        failed = f", {count(written.failed)} failed" if written.failed else ""
        rows.append(Row("written", (f"{count(written.written)}{failed}",)))
    return Section("STORE", ("",), tuple(rows))


def _age(last: CheckpointInfo, seen: Interval) -> str:
    """How old the last checkpoint is: by the server's clock, where it was written by this run."""
    metrics = seen.sample.metrics
    age_s = metrics.checkpoints.age_s if metrics else None
    if age_s is None:
        age_s = max(0.0, (seen.sample.stamp_ns - last.stamp_ns) / 1e9)
    return f"{duration(age_s)} ago"


def _queues(metrics: ServerMetrics | None) -> tuple[Section, ...]:
    """Those in which something waits, and that of the scans; of the others, how many there are."""
    if metrics is None:
        return ()
    rows = [
        _queue(name, queue)
        for name, queue in sorted(metrics.queues.items())
        if queue.waiting or name == _SCANS
    ]
    empty = len(metrics.queues) - len(rows)
    others = [Row(f"{empty} others", ("0", ""))] if empty else []
    return (Section("QUEUES", ("waiting", "limit"), (*rows, *others)),)


def _queue(name: str, queue: QueueMetrics) -> Row:
    grade = Grade.GOOD
    if queue.waiting >= queue.limit > 0:
        grade = Grade.ERROR
    elif queue.waiting >= _NEARLY_FULL * queue.limit:
        grade = Grade.WARNING
    return Row(name, (count(queue.waiting), count(queue.limit)), grade)
