"""What was seen of a server, for programs: a line of JSON."""

import time

from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.report import json_text
from triquad_tools.top.interval import Interval
from triquad_tools.top.problems import Problem, problems
from triquad_tools.top.watch import Silence, Target


def json_line(target: Target, seen: Interval | Silence) -> str:
    """One object on one line, with the same keys whether the server answers or not."""
    interval = seen if isinstance(seen, Interval) else None
    sample = interval and interval.sample
    report = {
        "time": utc_time(time.time_ns()),
        "endpoint": target.endpoint,
        "map": target.map_name,
        "silent": _silent(seen) if isinstance(seen, Silence) else None,
        "interval_s": interval and interval.seconds,
        "restarted": interval and interval.restarted,
        "problems": interval and [_problem(problem) for problem in problems(interval)],
        "rates": interval and interval.rates,
        "traffic": interval and interval.traffic,
        "status": sample and sample.status,
        "metrics": sample and sample.metrics,
        "metrics_missing": sample and sample.metrics_missing,
    }
    return json_text(report, indent=None)


def _silent(silence: Silence) -> dict[str, object]:
    return {"seconds": time.monotonic() - silence.since_s, "reason": silence.reason}


def _problem(problem: Problem) -> dict[str, str]:
    return {"grade": problem.grade.name.lower(), "text": problem.text}
