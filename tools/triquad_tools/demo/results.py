"""The measurements of the demonstration, as a table, and the promises about them."""

from dataclasses import dataclass

from triquad_tools.console.report import Row
from triquad_tools.demo.probe import ProbeReport
from triquad_tools.evaluation.map_scores import StreetScores
from triquad_tools.evaluation.metrics import MeshScores
from triquad_tools.evaluation.score_rows import mesh_rows, street_rows


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
    street: StreetScores
    mesh: MeshScores
    map_bytes: int  # of the map file
    parameters: int


def broken_promises(results: DemoResults) -> list[str]:
    """Return a line for each promise of the README that was not kept, with value and limit."""
    street, intake, queries = results.street, results.intake, results.queries
    at_least = {
        "mesh F-score": (results.mesh.f_score, 0.95),
        "houses UNKNOWN": (street.houses_unknown_ratio, 0.98),
    }
    at_most = {
        "SDF error (m)": (street.sdf_error_m, 0.02),
        "gradient angle (deg)": (street.gradient_angle_deg, 12.0),
        "scans lost or refused": (intake.lost + intake.refused, 0),
        "query errors": (queries.errors, 0),
        "answers from an older epoch": (queries.epochs_backwards, 0),
    }
    return [
        f"{name} is {value:.4g}; promised is {bound} {limit:g}"
        for bound, sign, promises in (("at least", 1, at_least), ("at most", -1, at_most))
        for name, (value, limit) in promises.items()
        if not sign * value >= sign * limit  # NaN keeps no promise
    ]


def table_rows(results: DemoResults) -> list[Row]:
    """Return the results as lines of a table."""
    intake, queries = results.intake, results.queries
    end = "until nothing was left to learn" if intake.settled else "cut off; still learning"
    return [
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
        *street_rows(results.street),
        *(Row(f"mesh {row.name}", row.value, row.note) for row in mesh_rows(results.mesh)),
        Row(
            "map file",
            f"{results.map_bytes / 1e6:.2f} MB",
            f"{results.parameters / 1e6:.2f} M parameters",
        ),
    ]
