"""Figures that benchmarks report, their bounds, and timing of two ways in turns."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number; a target is a bound that it should keep to."""

    name: str
    value: float
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def shown(self) -> str:
        """The value with its unit."""
        return f"{self.value:.3g} {self.unit}".rstrip()

    @property
    def kept(self) -> bool:
        """Whether the value is within its bounds; NaN never is."""
        low_enough = self.at_most is None or self.value <= self.at_most
        high_enough = self.at_least is None or self.value >= self.at_least
        return low_enough and high_enough

    @property
    def wanted(self) -> str:
        """The bound in words; empty where there is none."""
        if self.at_least is not None:
            return f"at least {self.at_least:g}"
        return "" if self.at_most is None else f"at most {self.at_most:g}"

    @property
    def verdict(self) -> str:
        """The bound and whether it is kept; empty where there is none."""
        return f"{self.wanted}: {'yes' if self.kept else 'NO'}" if self.wanted else ""


def seconds(work: Callable[[], object]) -> float:
    """Return how long ``work()`` takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


@dataclass(frozen=True)
class Comparison:
    """Two ways to do the same, timed in turns so that both meet the same noise."""

    seconds: float  # median of the one that is measured
    ratio: float  # median of how many times longer the baseline took


def compare(
    measured: Callable[[], object], baseline: Callable[[], object], rounds: int, repeats: int
) -> Comparison:
    """Time ``measured`` (each round ``repeats`` times, their median) against ``baseline``."""
    measured()
    baseline()
    times: list[float] = []
    ratios: list[float] = []
    for _ in range(rounds):
        mine = statistics.median(seconds(measured) for _ in range(repeats))
        times.append(mine)
        ratios.append(seconds(baseline) / mine)
    return Comparison(statistics.median(times), statistics.median(ratios))
