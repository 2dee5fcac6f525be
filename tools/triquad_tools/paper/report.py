"""The report of the paper's experiments: a page with tables, and the same as JSON."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from triquad_tools.console.report import json_text
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.paper.published_figures import (
    ABLATION_SOURCE,
    DENSE_SOURCE,
    PublishedScores,
    PublishedSet,
    Style,
)
from triquad_tools.paper.runs import ABLATED_EVERY, MemoryAt, Run

_COLUMNS = (
    "method",
    "figures",
    "parameters",
    "completion cm",
    "accuracy cm",
    "completion ratio %",
    "accuracy ratio %",
    "F %",
)
_ENCODINGS = {
    "both": "features and Fourier features",
    "features": "without Fourier features",
    "fourier": "without features",
}


@dataclass(frozen=True)
class Report:
    """All that was measured with a set of scans."""

    name: str
    style: Style
    published: PublishedSet
    scoring: ScoreSettings
    scans: int
    every: tuple[int, ...]
    memory: tuple[MemoryAt, ...]
    runs: tuple[Run, ...] = ()

    def json(self) -> str:
        """Return all figures as JSON."""
        return json_text(self)

    def page(self) -> str:
        """Return a section of Markdown."""
        parts = (self._head(), self._dense(), self._sparse(), self._ablation(), self._memory())
        return "\n".join(line for part in parts for line in part)

    def _head(self) -> Iterator[str]:
        near, cut, far = (
            f"{value:g} m"
            for value in (
                self.scoring.threshold_m,
                self.scoring.accuracy_cut_m,
                self.scoring.completion_cut_m,
            )
        )
        yield f"## {self.name}\n"
        yield f"{self.scans} scans. A distance below {near} is right."
        yield f"Samples of a mesh that are farther than {cut} from the truth do not count as to "
        yield f"accuracy, and distances of the completion end at {far}."
        yield f"Samples and truth are thinned to {100 * self.scoring.voxel_m:g} cm.\n"

    def _dense(self) -> Iterator[str]:
        yield "### Dense input\n"
        yield from _table_head(_COLUMNS)
        for run in self.whole():
            if run.every == min(self.every):
                yield _measured(run.method, run)
        yield from map(_published, self.published.dense)
        yield f"\nPublished: {DENSE_SOURCE}."

    def _sparse(self) -> Iterator[str]:
        yield "\n### Every n-th scan\n"
        yield "![ratios and parameters against n](sparse.png)\n"
        ratios = ("completion ratio %", "accuracy ratio %")
        yield from _table_head(("method", "n", "scans", "parameters", *ratios))
        for run in self.whole():
            completion, accuracy = run.scores.completion_ratio, run.scores.accuracy_ratio
            yield _row(
                run.method,
                run.every,
                run.scans,
                _count(run.parameters),
                f"{100 * completion:.1f}",
                f"{100 * accuracy:.1f}",
            )
        yield f"\nMeshes with n = {max(self.every)}, and their largest holes:\n"
        yield "![meshes with circled holes](holes.png)"

    def _ablation(self) -> Iterator[str]:
        every = ABLATED_EVERY * min(self.every)
        yield f"\n### Ablation, with n = {every}\n"
        yield from _table_head(_COLUMNS)
        for run in self.runs:
            if run.every == every and run.parameters is not None:
                yield _measured(f"{run.method}, {_ENCODINGS[run.encoding]}", run)
        if self.published.ablation:
            yield from map(_published, self.published.ablation)
            yield f"\nPublished: {ABLATION_SOURCE}."

    def _memory(self) -> Iterator[str]:
        yield "\n### Memory by number of scans\n"
        yield "![memory against scans](memory.png)\n"
        yield from _table_head(("scans", "parameters", "map file MB", "memory MB"))
        for point in self.memory:
            file_mb, memory_mb = point.file_bytes / 1e6, point.memory_bytes / 1e6
            yield _row(point.scans, f"{point.parameters:,}", f"{file_mb:.2f}", f"{memory_mb:.0f}")
        yield ""

    def whole(self) -> Sequence[Run]:
        """Return the runs with each n-th scan, without those of the ablation alone."""
        return [run for run in self.runs if run.encoding == "both" and run.every in self.every]


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _table_head(columns: Sequence[str]) -> Iterator[str]:
    yield _row(*columns)
    yield _row(*("---" for _ in columns))


def _measured(name: str, run: Run) -> str:
    scores = run.scores
    lengths = (f"{100 * value:.2f}" for value in (scores.completion_m, scores.accuracy_m))
    shares = (scores.completion_ratio, scores.accuracy_ratio, scores.f_score)
    ratios = (f"{100 * value:.2f}" for value in shares)
    return _row(name, "here", _count(run.parameters), *lengths, *ratios)


def _published(row: PublishedScores) -> str:
    one, other = row.completion_percent, row.accuracy_percent
    values = (row.completion_cm, row.accuracy_cm, one, other, 2 * one * other / (one + other))
    cells = (f"{value:.2f}" for value in values)
    return _row(row.method, "published", _count(row.parameters), *cells)


def _count(parameters: int | None) -> str:
    return "-" if parameters is None else f"{parameters:,}"
