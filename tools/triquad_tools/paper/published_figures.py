"""Figures that papers have published, to compare measured ones with."""

from dataclasses import dataclass
from typing import Literal

Style = Literal["maicity", "newer-college"]


@dataclass(frozen=True)
class PublishedScores:
    """A row of a paper's table of dense input."""

    method: str
    parameters: int | None  # that are learnt; None: it has none
    completion_cm: float
    accuracy_cm: float
    completion_percent: float  # share below the threshold
    accuracy_percent: float


@dataclass(frozen=True)
class PublishedSet:
    """What is published about a set of scans, and how it is scored.

    Thresholds are those of the paper's tables I and II.
    """

    threshold_m: float
    accuracy_cut_m: float
    every: tuple[int, ...]  # each n-th scan of which the paper's plots tell
    dense: tuple[PublishedScores, ...]
    completion_percent: dict[str, tuple[float, ...]]  # with every n-th scan, read off the plots
    ablation: tuple[PublishedScores, ...] = ()


DENSE_SOURCE = "3QFP (ICRA 2024), table I"
ABLATION_SOURCE = "3QFP (ICRA 2024), ablation"

SETS: dict[Style, PublishedSet] = {
    "maicity": PublishedSet(
        threshold_m=0.1,
        accuracy_cut_m=0.2,
        every=(1, 2, 3, 4, 5, 6),
        dense=(
            PublishedScores("VDBFusion", None, 27.33, 1.36, 78.12, 99.13),
            PublishedScores("SHINE-Mapping", 4_530_000, 3.34, 1.66, 95.43, 97.09),
            PublishedScores("3QFP", 1_270_000, 2.68, 1.52, 97.27, 97.60),
        ),
        completion_percent={
            "VDBFusion": (78.1, 73.5, 69.1, 65.9, 58.6, 58.1),
            "SHINE-Mapping": (95.4, 93.8, 92.2, 90.9, 90.9, 88.5),
            "3QFP": (97.3, 96.0, 92.2, 92.6, 91.1, 90.8),
        },
        ablation=(
            PublishedScores("3QFP, features", None, 8.05, 3.07, 90.95, 94.71),
            PublishedScores("3QFP, fourier", None, 9.27, 2.95, 89.44, 96.30),
            PublishedScores("3QFP, both", None, 7.88, 2.60, 91.10, 96.25),
        ),
    ),
    "newer-college": PublishedSet(
        threshold_m=0.2,
        accuracy_cut_m=0.4,
        every=(3, 6, 9, 12, 15, 18),
        dense=(
            PublishedScores("VDBFusion", None, 13.20, 5.50, 91.51, 98.10),
            PublishedScores("SHINE-Mapping", 11_400_000, 9.55, 7.60, 94.58, 91.37),
            PublishedScores("3QFP", 1_600_000, 9.68, 6.72, 94.10, 93.69),
        ),
        completion_percent={
            "VDBFusion": (91.5, 93.5, 85.5, 81.9, 78.0, 73.5),
            "3QFP": (94.1, 94.1, 93.8, 93.1, 92.9, 93.4),
        },
    ),
}
