"""The experiments of the 3QFP paper, on a folder of scans: each run makes a map, and scores it."""

import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from triquad_client import Mesh, open_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import ENCODINGS, Encoding
from triquad_format.records.region import MapRecord
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.resources import give_back_free, resident_bytes
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up

from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings
from triquad_tools.evaluation.shine_protocol import shine_scores
from triquad_tools.mapfiles.crop import without_training
from triquad_tools.mapping.learning import learn
from triquad_tools.paper.intake import taken
from triquad_tools.paper.other_mappers import installed_mappers
from triquad_tools.paper.published_method import published_map
from triquad_tools.sensors.sweep import PosedScan

LEARNED = ("triquad", "as published")
"""The methods of this project; others are those that are installed."""

ABLATED_EVERY = 5
"""The paper's ablation takes each fifth scan of its densest input."""

_TENTHS = 10


@dataclass(frozen=True)
class Run:
    """A map of some of the scans, and how good it is."""

    method: str
    every: int  # n: each n-th scan is used
    encoding: Encoding
    scans: int
    parameters: int | None  # that are learnt; None: it has none
    file_bytes: int | None  # of the map file without training state
    samples: int | None  # it was trained on
    seconds: float  # for the map and its mesh
    scores: MeshScores


@dataclass(frozen=True)
class MemoryAt:
    """The memory of a map after some scans."""

    scans: int
    parameters: int
    file_bytes: int
    memory_bytes: int  # of the process, beyond what it took before the first scan


@dataclass(frozen=True)
class Task:
    """What all runs share."""

    scans: Sequence[PosedScan]
    reference: Doubles  # [M, 3] true surface points, metres
    settings: Settings
    scoring: ScoreSettings
    samples: int  # on which a map as published is trained


def all_runs(
    task: Task, every: Sequence[int], methods: Sequence[str]
) -> Iterator[tuple[Run, Mesh]]:
    """Yield maps of each n-th scan by some methods, and those of the ablation, with their meshes.

    Args:
        task: scans, truth and settings.
        every: the numbers n.
        methods: what maps them.
    """
    with closing(Teams()) as teams:
        _prepare(task.settings, teams)
        for method in methods:
            for n, encoding in _variants(method, every):
                yield _run(task, method, n, encoding, teams)


def scans_needed(every: Sequence[int]) -> int:
    """Return how many scans there have to be: two for the sparsest map, at least."""
    return 1 + max(*every, ABLATED_EVERY * min(every))


def _variants(method: str, every: Sequence[int]) -> list[tuple[int, Encoding]]:
    """Return the numbers n and the encodings of a method's runs."""
    variants: list[tuple[int, Encoding]] = [(n, "both") for n in every]
    ablated = ABLATED_EVERY * min(every)
    others = [(ablated, encoding) for encoding in ENCODINGS]
    return list(dict.fromkeys([*variants, *others])) if method in LEARNED else variants


def _run(task: Task, method: str, every: int, encoding: Encoding, teams: Teams) -> tuple[Run, Mesh]:
    """Map each n-th scan, and score the mesh."""
    scans = task.scans[::every]
    started_s = time.monotonic()
    record, size = None, None
    if method in LEARNED:
        settings = task.settings.with_field(replace(task.settings.field, encoding=encoding))
        if method == "triquad":
            record = _learnt(scans, settings, teams)
        else:
            record = published_map(scans, settings, task.samples, teams)
        mesh, size = _meshed(record)
    else:
        mesh = installed_mappers()[method](scans)
    seconds = time.monotonic() - started_s
    run = Run(
        method=method,
        every=every,
        encoding=encoding,
        scans=len(scans),
        parameters=None if record is None else sum(one.parameters for one in record.regions),
        file_bytes=size,
        samples=None if record is None else record.progress.samples_trained,
        seconds=seconds,
        scores=shine_scores(mesh, task.reference, task.scoring),
    )
    return run, mesh


def _learnt(scans: Sequence[PosedScan], settings: Settings, teams: Teams) -> MapRecord:
    """Return the map of scans by triquad's own choices, with nothing left to learn."""
    mapper = Mapper("paper", settings, "cpu", teams=teams)
    for _ in taken(mapper, scans, len(scans)):
        mapper.train()
    learn(mapper)
    return mapper.publish().record()


def _meshed(record: MapRecord) -> tuple[Mesh, int]:
    """Return the mesh of a map, with cells of half a leaf, and the bytes of its file."""
    with tempfile.TemporaryDirectory(prefix="triquad-paper-") as folder:
        path = Path(folder) / "map.triquad"
        size = write_map(without_training(record), path).bytes
        with open_map(path) as opened:
            return opened.mesh(), size


def memory_by_scans(scans: Iterable[PosedScan], total: int, settings: Settings) -> list[MemoryAt]:
    """Return the memory of triquad's map at each tenth of ``total`` scans; nothing is trained.

    The scans are read as they are taken in, so that the memory is that of the map.
    """
    points = []
    with closing(Teams()) as teams, tempfile.TemporaryDirectory(prefix="triquad-paper-") as folder:
        _prepare(settings, teams)
        mapper = Mapper("paper", settings, "cpu", teams=teams)
        give_back_free()
        before = resident_bytes()
        tenths = {total * (part + 1) // _TENTHS for part in range(_TENTHS)}
        for count in taken(mapper, scans, total):
            if count in tenths:
                record = mapper.publish().record()
                size = write_map(record, Path(folder) / f"{count}.triquad").bytes
                parameters = sum(one.parameters for one in record.regions)
                del record
                give_back_free()
                points.append(MemoryAt(count, parameters, size, resident_bytes() - before))
    return points


def _prepare(settings: Settings, teams: Teams) -> None:
    with progress("preparing") as report:
        warm_up(settings, "cpu", teams, report=lambda stage: report(0.0, stage))
