"""``triquad-bench`` of clouds that are skewed by motion: what taking it out of them regains."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from triquad_sensors.motion.frame_tree import FrameTree
from triquad_sensors.motion.placing import place
from triquad_sensors.sweep import PosedScan, Sweep

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import settled_mapper
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.map_scores import StreetProbes, driven_street, score_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street
from triquad_tools.simulation.sweeps import SWEEP_S, WORLD, SteadyMotion, sweep

_SCANS = 80
_MOTION = SteadyMotion((5.0, -1.6, 1.8), speed_m_s=10.0, yaw_rate_rad_s=1.0)


def measure_sweeps(seed: int) -> list[Figure]:
    """Errors of maps of a sensor at 10 m/s and 1 rad/s, against one that stood for each scan."""
    scene, lidar = street(seed), Lidar()
    starts = [SWEEP_S * number for number in range(_SCANS)]
    middles = np.stack([_MOTION.pose(start + SWEEP_S / 2).matrix() for start in starts])
    still = driven_street(SimulatedDrive(scene, lidar, middles, seed=seed))
    sweeps = _sweeps(seed, starts)
    frames = _MOTION.frames(starts[-1] + SWEEP_S)
    skewed = [replace(each, offsets_s=None, stamp_ns=_middle_ns(each)) for each in sweeps]
    errors_m = {
        "of scans from a standstill": _error_m(still.scans, still.probes),
        "of sweeps with their motion taken out": _error_m(_placed(sweeps, frames), still.probes),
        "of sweeps as they are": _error_m(_placed(skewed, frames), still.probes),
    }
    figures = [Figure(f"SDF error {name}", 100 * error, "cm") for name, error in errors_m.items()]
    standing, corrected, _ = errors_m.values()
    ratio = corrected / standing
    return [*figures, Figure("SDF error, motion taken out", ratio, "x standing", at_most=1.2)]


def _sweeps(seed: int, starts: Sequence[float]) -> list[Sweep]:
    scene, lidar = street(seed), Lidar()
    sweeps: list[Sweep] = []
    with progress("sweeping", len(starts)) as report:
        for number, start_s in enumerate(starts):
            rng = np.random.default_rng([seed, number])
            sweeps.append(sweep(scene, lidar, _MOTION, start_s=start_s, rng=rng))
            report(number + 1, f"{number + 1} of {len(starts)} sweeps")
    return sweeps


def _middle_ns(each: Sweep) -> int:
    return each.stamp_ns + round(0.5e9 * SWEEP_S)


def _placed(sweeps: Sequence[Sweep], frames: FrameTree) -> list[PosedScan]:
    return [place(each, frames, WORLD) for each in sweeps]


def _error_m(scans: Sequence[PosedScan], probes: StreetProbes) -> float:
    epoch = settled_mapper("sweeps", scans).publish()
    return score_street(epoch.query, probes).sdf_error_m
