"""The measurements of the demonstration, as a table, and the promises about them."""

from dataclasses import dataclass

from triquad_tools.console.report import Row, centimetres, percent
from triquad_tools.demo.probe import ProbeReport
from triquad_tools.evaluation.map_scores import StreetScores
from triquad_tools.evaluation.metrics import MeshScores


@dataclass(frozen=True)
class Intake:
    """The figures of integrating and learning scans."""

    scans: int
    taken: int
    refused: int
    lost: int
    points: int
    seconds: float  # from the first scan until all were integrated
    learning_s: float  # from the first scan until nothing was left to learn, or the limit
    settled: bool  # False: the limit came first
    samples_trained: int

    @property
    def scans_per_s(self) -> float:
        """Scans integrated per second."""
        return self.taken / max(self.seconds, 1e-9)

    @property
    def samples_per_s(self) -> float:
        """Training samples per second, while scans were integrated and after."""
        return self.samples_trained / max(self.learning_s, 1e-9)


@dataclass(frozen=True)
class Restart:
    """The difference of answers after the server was stopped and started again."""

    points: int
    sdf_difference_max_m: float
    statuses_changed: int


@dataclass(frozen=True)
class MapSize:
    """The map as a file, and in memory."""

    bytes: int  # without the state that only training needs
    bytes_with_training: int
    parameters: int


@dataclass(frozen=True)
class DemoResults:
    """All measurements of the demonstration."""

    seed: int
    cpus: int
    intake: Intake
    queries: ProbeReport
    street: StreetScores
    mesh: MeshScores
    restart: Restart
    size: MapSize
    phases_s: dict[str, float]

    @property
    def seconds(self) -> float:
        """The duration of all phases."""
        return sum(self.phases_s.values())


def broken_promises(results: DemoResults) -> list[str]:
    """Return a line for each promise of the README that was not kept, with value and limit."""
    street, restart = results.street, results.restart
    at_least = {
        "mesh F-score": (results.mesh.f_score, 0.95),
        "houses UNKNOWN": (street.houses_unknown_ratio, 0.98),
    }
    at_most: dict[str, tuple[float, float]] = {
        "SDF error (m)": (street.sdf_error_m, 0.02),
        "gradient angle (deg)": (street.gradient_angle_deg, 12.0),
        "scans lost or refused": (results.intake.lost + results.intake.refused, 0),
        "query errors": (results.queries.errors, 0),
        "answers from an older epoch": (results.queries.epochs_backwards, 0),
    }
    if results.intake.settled:  # a map that still learns may change
        at_most["restart difference (m)"] = (restart.sdf_difference_max_m, 0.002)
        at_most["statuses changed by the restart"] = (restart.statuses_changed, 0)
    return [
        f"{name} is {value:.4g}; promised is {bound} {limit:g}"
        for bound, sign, promises in (("at least", 1, at_least), ("at most", -1, at_most))
        for name, (value, limit) in promises.items()
        if not sign * value >= sign * limit  # NaN keeps no promise
    ]


def table_rows(results: DemoResults) -> list[Row]:
    """Return the results as lines of a table."""
    return [
        *_speed_rows(results.intake, results.queries),
        *_quality_rows(results.street, results.mesh),
        *_file_rows(results.size, results.restart, results.intake.settled),
        Row("everything together", f"{results.seconds:.0f} s", f"on {results.cpus} CPUs"),
    ]


def _speed_rows(intake: Intake, queries: ProbeReport) -> list[Row]:
    settled = "until nothing was left to learn" if intake.settled else "cut off; still learning"
    return [
        Row(
            "scans taken in",
            f"{intake.scans_per_s:.1f} /s",
            f"{intake.taken} of {intake.scans}, {intake.points / intake.scans:,.0f} points each",
        ),
        Row(
            "training",
            f"{intake.samples_per_s / 1e6:.2f} M samples/s",
            f"{intake.samples_trained / 1e6:.1f} M in {intake.learning_s:.0f} s, {settled}",
        ),
        Row(
            f"query of {queries.points:,} points",
            f"{queries.latency_p50_ms:.1f} ms",
            f"median while training; 99 %: {queries.latency_p99_ms:.1f} ms, longest "
            f"{queries.latency_max_ms:.1f} ms",
        ),
        Row(
            "queries while training",
            f"{queries.queries:,}",
            f"{queries.errors} errors, answered from {queries.epochs} epochs",
        ),
    ]


def _quality_rows(street: StreetScores, mesh: MeshScores) -> list[Row]:
    return [
        Row(
            "SDF error",
            centimetres(street.sdf_error_m),
            f"mean, within 10 cm of the surface; median {centimetres(street.sdf_error_median_m)}",
        ),
        Row("gradient angle", f"{street.gradient_angle_deg:.1f} deg", "median, same points"),
        Row("houses UNKNOWN", percent(street.houses_unknown_ratio), "deeper than 0.5 m in them"),
        Row(
            "mesh accuracy",
            centimetres(mesh.accuracy_m),
            f"mean, against the exact surface; median {centimetres(mesh.accuracy_median_m)}",
        ),
        Row("mesh completion", centimetres(mesh.completion_m), "mean, of what the lidar hit"),
        Row(
            "mesh F-score",
            percent(mesh.f_score),
            f"at 10 cm: accuracy {percent(mesh.accuracy_ratio)}, completion "
            f"{percent(mesh.completion_ratio)}",
        ),
        Row("mesh outliers", percent(mesh.outlier_ratio), "farther than 20 cm from the surface"),
    ]


def _file_rows(size: MapSize, restart: Restart, settled: bool) -> list[Row]:
    learning = "" if settled else "; it went on learning meanwhile"
    return [
        Row("map file", f"{size.bytes / 1e6:.2f} MB", f"{size.parameters / 1e6:.2f} M parameters"),
        Row("with training state", f"{size.bytes_with_training / 1e6:.2f} MB", "checkpoint"),
        Row(
            "after a restart",
            f"{1e3 * restart.sdf_difference_max_m:.3f} mm",
            f"largest change of {restart.points:,} answers, {restart.statuses_changed} other "
            f"statuses{learning}",
        ),
    ]
