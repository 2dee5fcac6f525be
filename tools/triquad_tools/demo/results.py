"""The measurements of the demonstration, as a table, and the promises about them."""

import math
from dataclasses import dataclass

from triquad_format.wire.messages import FieldFit

from triquad_tools.console.amounts import millimetres
from triquad_tools.console.report import Row
from triquad_tools.demo.probe import ProbeReport


@dataclass(frozen=True)
class Intake:
    """The figures of integrating and learning scans."""

    scans: int
    taken: int
    refused: int
    lost: int
    seconds: float  # from the first scan until all were integrated
    learning_s: float  # from the first scan until nothing was left to learn, or the limit
    settled: bool  # False: the limit came first
    samples_trained: int


@dataclass(frozen=True)
class DemoResults:
    """All measurements of the demonstration."""

    seed: int
    intake: Intake
    queries: ProbeReport
    fit: FieldFit | None  # to rays that were never trained on; None: there are too few
    map_bytes: int  # of the map file
    parameters: int
    faces: int  # of the mesh


def broken_promises(results: DemoResults) -> list[str]:
    """Return a line for each promise that was not kept, with value and limit."""
    intake, queries, fit = results.intake, results.queries, results.fit
    at_most = {
        "error at held-out rays (m)": (math.nan if fit is None else fit.median_m, 0.01),
        "scans lost or refused": (intake.lost + intake.refused, 0),
        "query errors": (queries.errors, 0),
        "answers from an older epoch": (queries.epochs_backwards, 0),
    }
    return [
        f"{name} is {value:.4g}; promised is at most {limit:g}"
        for name, (value, limit) in at_most.items()
        if not value <= limit  # NaN keeps no promise
    ]


def table_rows(results: DemoResults) -> list[Row]:
    """Return the results as lines of a table."""
    intake, queries, fit = results.intake, results.queries, results.fit
    end = "until nothing was left to learn" if intake.settled else "cut off; still learning"
    rows = [
        Row(
            "scans taken in",
            f"{intake.taken / max(intake.seconds, 1e-9):.1f} /s",
            f"{intake.taken} of {intake.scans}",
        ),
        Row(
            "training",
            f"{intake.samples_trained / 1e6 / max(intake.learning_s, 1e-9):.2f} M samples/s",
            f"{intake.samples_trained / 1e6:.1f} M in {intake.learning_s:.0f} s, {end}",
        ),
        Row(
            f"query of {queries.points:,} points",
            f"{queries.latency_p50_ms:.1f} ms",
            f"median of {queries.queries:,} while training; 99 %: {queries.latency_p99_ms:.1f} ms, "
            f"longest {queries.latency_max_ms:.1f} ms, {queries.errors} errors",
        ),
        Row(
            "map file",
            f"{results.map_bytes / 1e6:.2f} MB",
            f"{results.parameters / 1e6:.2f} M parameters",
        ),
        Row("mesh", f"{results.faces:,}", "faces"),
    ]
    if fit is not None:
        note = f"90 % in {millimetres(fit.upper_m)}, of {fit.rays:,} rays that were never learnt"
        rows.insert(3, Row("error at held-out rays", millimetres(fit.median_m), note))
    return rows
