"""Has kernels compiled before they are needed, by maps and questions that are made up.

At the very first start that takes half a minute or more; then the compiled code is found on disk.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import (
    BLOCK_BYTES,
    MARGIN_BITS,
    OUTCOME_BITS,
    Evidence,
    MapRecord,
    surface_counts,
)
from triquad_map.compiled.evidence.contradictions import Disbelief
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.kernel import compiled_marks
from triquad_map.compiled.surfels.surfel_map import first_surfels
from triquad_map.composition.field_view import field_samples
from triquad_map.composition.region import no_surfels
from triquad_map.questions.distance import DistanceOptions, distances
from triquad_map.surface import FieldSample

from triquad_server.engine.compiled_trainer import GradientSums
from triquad_server.engine.field_record import region_record
from triquad_server.engine.live_field import Batch, LiveField, Rates, initial_field
from triquad_server.engine.memory import memory_on
from triquad_server.engine.trainer import trainer_of
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.normals import SurfaceNormals
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import MemorySettings, Settings

ANSWERING = ("field", "surfels", "questions")
"""The stages whose kernels answer."""

MAPPING = ("scans", "training", "what_is_gone")
"""Those that map."""

MESHING = ("meshes",)
"""And those of meshes."""

STAGES = ANSWERING + MAPPING + MESHING

_SCANS = 6  # of rays that pass the sphere, until it is taken back
_DIRECTIONS = 400
_RADIUS_M = 3.0


def warm_up(
    settings: Settings,
    device: str,
    teams: Teams | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Have all kernels compiled; ``report`` is told what comes next."""
    made_up = WarmUp(settings, device, teams or Teams())
    for stage in STAGES:
        report(stage.replace("_", " "))
        made_up.go_through(stage)


def can_keep() -> bool:
    """Whether there is a place for compiled code."""
    return compiled_marks(__name__) is not None


def is_compiled(stage: str) -> bool:
    """Whether the kernels of a stage were compiled on this machine, and their code was kept."""
    marks = compiled_marks(__name__)
    return marks is not None and (marks / stage).exists()


def _mark_compiled(stage: str) -> None:
    marks = compiled_marks(__name__)
    if marks is not None:
        with suppress(OSError):
            marks.mkdir(parents=True, exist_ok=True)
            (marks / stage).touch()


class WarmUp:
    """Stages of which each uses kernels, and comes to others of them first; in any order."""

    def __init__(self, settings: Settings, device: str, teams: Teams) -> None:
        # With room for what is made up.
        self._settings = settings.model_copy(update={"memory": MemorySettings()})
        self._device = device
        self._teams = teams
        count = min(_DIRECTIONS, settings.scan.max_points)
        directions = np.random.default_rng(0).normal(size=(count, 3))
        self._directions: Doubles = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        scan = settings.scan
        self._radius_m = min(max(_RADIUS_M, scan.range_min_m), scan.range_max_m)

    def go_through(self, stage: str) -> None:
        """Have the kernels of a stage, which is a method's name, compiled or found."""
        getattr(self, stage)()
        _mark_compiled(stage)

    def field(self) -> None:
        """A field answers."""
        field = self._field()
        field.freeze().evaluate(self._points(100), gradient=True)

    def surfels(self) -> None:
        """What was seen answers, and its surface, as it would be were the field flat."""
        field = self._settings.field
        points = float(1 << field.depth - 1) + self._directions
        evidence = self._evidence()
        frozen = evidence.freeze(self._teams.answers.split)
        frozen.status(points)
        frozen.near_ends(points, reach=0.5)
        surfels = first_surfels(frozen, _flat, epoch=1)
        surfels.find_nearest(points, no_surfels(np.full(len(points), float(BLOCK_VOXELS))))
        distances = np.ones(len(points))
        frozen.find_unknown(points, field.owned_blocks, distances, nearest=np.empty(points.shape))
        evidence.set_discs(surfels.voxels(), surfels.surfels)

    def steps(self) -> None:
        """A field takes steps of training."""
        field = self._field()
        trainer = trainer_of(field, GradientSums(), self._teams.mapping)
        points = self._points(100)
        training = self._settings.training
        rates = Rates(training.learning_rate, training.beta1, training.beta2, young_rate=0.0)
        trainer.train(Batch(points, points[:, 0].copy()), rates)

    def normals(self) -> None:
        """Ends of rays tell normals."""
        normals = SurfaceNormals(self._settings.field.leaf_m, self._teams.mapping)
        normals.add(self._directions * self._radius_m, np.zeros(3))

    def questions(self) -> None:
        """A restored map answers."""
        epoch = self._restored.publish()
        points = self._directions
        epoch.query(points, gradient=True)
        distances(epoch, points, DistanceOptions(unknown_distance=True))

    def meshes(self) -> None:
        """A restored map has a mesh."""
        cache = TileCache(self._settings.mesh, self._teams.meshing)
        cache.refresh(self._restored.publish())
        cache.make(0, (0, 0, 0))

    def scans(self) -> None:
        """Scans are taken in."""
        mapper = self._mapper
        rays = mapper.ingest((self._directions * self._radius_m).astype(np.float32), np.eye(4))
        mapper.regions[0].growth_by(rays)
        mapper.publish()

    def training(self) -> None:
        """A map is trained, all of it and a part."""
        self._mapper.train()
        self._mapper.publish()
        again = Mapper(
            "warm-up",
            self._settings,
            self._device,
            self._mapper.changes_since(None).record,
            self._teams,
        )
        again.publish()
        (region, *_) = again.regions
        blocks = region.evidence.surface_blocks()
        region.field.hold(region.field.tree.rows_under(blocks, BLOCK_VOXELS))
        region.field.live_view().evaluate(self._points(100), gradient=True)
        region.pool.focus(blocks)  # as if it were seen anew
        again.train()
        region.pool.limit(len(region.pool) - 1)
        new = np.zeros(len(region.pool), np.bool_)
        new[: len(new) // 4] = True
        region.pool.add(region.pool.table.of(new))  # in place of others

    def taking_back(self) -> None:
        """Surface that rays contradict goes, on which nothing was trained."""
        (region, *_) = self._restored.regions
        evidence, field = region.evidence, region.field
        change = self._settings.change
        rule = Disbelief.of(change.scans, change.doubt)
        samples = field_samples(field.freeze(), field.settings, self._teams.mapping.split)
        passed = np.zeros(0, np.int32)
        evidence.take_back(passed, rule)
        evidence.take_back_unseen(passed, rule, samples)

    def what_is_gone(self) -> None:
        """Rays pass what was there until it is gone."""
        points = (2 * self._directions * self._radius_m).astype(np.float32)
        for _ in range(_SCANS):
            self._mapper.ingest(points, np.eye(4))
        self._mapper.publish()

    @cached_property
    def _mapper(self) -> Mapper:
        return Mapper("warm-up", self._settings, self._device, teams=self._teams)

    @cached_property
    def _restored(self) -> Mapper:
        """A map of a few blocks of surface in the middle of a region."""
        region = region_record((0, 0, 0), self._field(), self._evidence(), training=None)
        record = MapRecord("warm-up", 1, self._settings.field, (region,))
        return Mapper("warm-up", self._settings, self._device, record, self._teams)

    def _evidence(self) -> LiveEvidence:
        """A few rows of surface in the middle of a region."""
        side = 1 << self._settings.field.depth
        block = np.full((1, 3), side // BLOCK_VOXELS // 2)
        surface = np.zeros((1, BLOCK_BYTES), np.uint8)
        surface[:, 0] = 255
        voxels = int(surface_counts(surface).sum())
        record = Evidence(
            morton.encode(block),
            surface,
            ~surface,
            levels=np.zeros(voxels, np.uint8),
            seen_s=np.zeros(1, np.int64),
            outcomes=np.zeros((voxels, len(OUTCOME_BITS)), np.uint8),
            margins=np.zeros((voxels, len(MARGIN_BITS)), np.uint8),
        )
        return LiveEvidence.from_record(side, record)

    def _points(self, count: int) -> Floats:
        """Points [count, 3] in the middle of a region."""
        side_m = BLOCK_VOXELS * self._settings.field.leaf_m
        shares = np.random.default_rng(0).random((count, 3), np.float32)
        points: Floats = shares * np.float32(side_m)
        return points

    def _field(self) -> LiveField:
        """A field of which nothing is learnt, with room for surface."""
        settings = self._settings.field
        field = initial_field(settings, memory_on(self._device), seed=0)
        side = np.arange(BLOCK_VOXELS) + (1 << settings.depth) // 2
        field.grow(np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3))
        return field


def _flat(points: Doubles) -> FieldSample:
    """A field that is zero everywhere."""
    values, gradients = np.zeros(len(points), np.float32), np.zeros((len(points), 3), np.float32)
    return FieldSample(values, gradients)
