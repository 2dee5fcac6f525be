"""``triquad-bench`` as the map grows: from 1 to 16 regions, far apart, in a process of its own.

Run as ``python -m triquad_tools.benchmarks.growth SEED``; prints its figures as JSON.
"""

import json
import statistics
import sys
from dataclasses import asdict
from functools import partial

import numpy as np
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.memory import resident_bytes
from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up

from triquad_tools.benchmarks.figures import Figure, seconds
from triquad_tools.console.lines import print_line
from triquad_tools.simulation.street import street_drive

_REGIONS = 16
_SCANS = 25
_STEP_M = 4.0  # 100 m of street for each region
_POINTS = 50_000
_STEPS = 60


def measure_growth(seed: int) -> list[Figure]:
    """How training steps, queries and memory change with the number of regions."""
    settings = Settings()
    warm_up(settings, "cpu")
    scans = list(street_drive(seed, _SCANS, _STEP_M))
    hits = np.concatenate([scan.true_hits[::20] for scan in scans])
    rng = np.random.default_rng(seed)
    mapper = Mapper("bench", settings, "cpu")
    steps: list[float] = []
    queries: list[float] = []
    resident: list[int] = []
    for number in range(_REGIONS):
        shift = np.eye(4)
        shift[0, 3] = number * settings.field.region_pitch_m
        for scan in scans:
            mapper.ingest(scan.points, shift @ scan.world_from_sensor)
            mapper.train()
        steps.append(statistics.median(seconds(mapper.train) for _ in range(_STEPS)))
        epoch = mapper.publish()
        # All over the map so far.
        points = hits[rng.integers(len(hits), size=_POINTS)]
        points[:, 0] += rng.integers(number + 1, size=_POINTS) * shift[0, 3] / max(1, number)
        query = partial(epoch.query, points)
        queries.append(statistics.median(seconds(query) for _ in range(9)))
        resident.append(resident_bytes())
    each = np.diff(resident) / 1e6  # 100 m of street each
    # Medians: the replay pool fills up once.
    halves = np.median(each[: len(each) // 2]), np.median(each[len(each) // 2 :])
    return [
        Figure("training step, 16 regions against 1", steps[-1] / steps[0], "", at_most=1.3),
        Figure("query, 16 regions against 1", queries[-1] / queries[0], "", at_most=1.3),
        Figure("resident memory per 100 m of street", float(np.median(each)), "MB"),
        Figure(
            "the same, second 800 m against the first",
            float(halves[1] / halves[0]),
            "",
            at_least=0.8,
            at_most=1.2,
        ),
        Figure("resident memory with 16 regions", resident[-1] / 1e6, "MB"),
    ]


if __name__ == "__main__":
    print_line(json.dumps([asdict(figure) for figure in measure_growth(int(sys.argv[1]))]))
