"""The map's core in this process: integrating scans, training, queries, publishing.

The baseline is the engine of tensors with automatic differentiation, on all cores.
"""

import argparse
import statistics
from functools import partial

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.mesh.tile_mesh import mesh_tile
from triquad_server.engine.live_field import Batch
from triquad_server.engine.tensor_field import TensorField, tensors_of
from triquad_server.engine.tensor_trainer import TensorTrainer
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import tile_lattice
from triquad_server.mesh.tile_queries import surface_tiles
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings, Settings
from triquad_tools.console.progress import progress

from bench.figures import Figure, compare, seconds
from bench.street import bench_street
from bench.street_scores import DrivenStreet

_QUERY_POINTS = 100_000
_ROUNDS = 9
_FIRST_SCANS = 20  # they meet only new surface, and are not counted
_RATE = 1e-4  # of learning: so slow that the baseline leaves the field as it is


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of the map's core, which trains on a device."""
    made = bench_street(options.seed)
    mapper = Mapper("bench", Settings(), options.device)
    with progress("core", 4) as report:
        report(0, "taking in scans")
        ingest_s = [
            seconds(partial(mapper.ingest, scan.points, scan.world_from_sensor))
            for scan in made.scans
        ]
        for _ in range(400):  # so that no rays are new any more
            mapper.train()
        epoch = mapper.publish()
        points = seen_points(epoch, made, np.random.default_rng(0))
        region = max(mapper.regions, key=lambda region: region.field.vertices)
        report(1, "training")
        figures = _training(region)
        report(2, "queries")
        figures += _queries(epoch, region, points)
        report(3, "publishing")
        figures.append(_publishing(mapper))
        report(4, "done")
    scan_ms = 1e3 * statistics.median(ingest_s[_FIRST_SCANS:])
    points_mean = float(np.mean([len(scan.points) for scan in made.scans]))
    return [
        Figure("mesh of the whole street", _mesh_s(epoch, made), "s", at_most=3),
        Figure("parameters of the map", epoch.parameters / 1e6, "M"),
        Figure(f"take in a scan of {points_mean:,.0f} points", scan_ms, "ms", at_most=30),
        *figures,
    ]


def seen_points(epoch: Epoch, made: DrivenStreet, rng: np.random.Generator) -> Doubles:
    """Return random points [N, 3] of what rays have shown of the street, free or surface."""
    low, high = made.drive.scene.bounds
    found: list[Doubles] = []
    while sum(map(len, found)) < _QUERY_POINTS:
        points = rng.uniform(low, high, (_QUERY_POINTS, 3))
        found.append(points[epoch.status(points) != Status.UNKNOWN])
    return np.concatenate(found)[:_QUERY_POINTS]


def _training(region: LiveRegion) -> list[Figure]:
    learning = region.training
    trainer = TensorTrainer(region.field)
    rng = np.random.default_rng(0)

    def baseline() -> None:
        batch = learning.rays.draw(learning.batch, 0)
        order = rng.permutation(learning.batch)  # tensors do not put it in order
        trainer.train(Batch(batch.points[order], batch.labels[order]), _RATE)

    step = compare(region.take_step, baseline, _ROUNDS, repeats=15)
    return [
        Figure("training", learning.batch / step.seconds / 1e6, "M samples/s", at_least=1.0),
        Figure("training, times eager torch", step.ratio, "", at_least=8),
    ]


def _queries(epoch: Epoch, region: LiveRegion, points: Doubles) -> list[Figure]:
    local = (points - region.centre).astype(np.float32)
    field, team = region.field, Teams().answers
    slow, fast = TensorField(field.settings, field.tree, tensors_of(field)), field.freeze()

    def ratio(gradient: bool) -> float:
        def evaluate(first: int, last: int) -> None:
            fast.evaluate(local[first:last], gradient)

        return compare(
            lambda: team.split(len(local), evaluate),
            lambda: slow.evaluate(local, gradient),
            _ROUNDS,
            repeats=5,
        ).ratio

    def rate(gradient: bool) -> float:
        times = [seconds(lambda: epoch.query(points, gradient)) for _ in range(5 * _ROUNDS)]
        return len(points) / statistics.median(times) / 1e6

    plain, steep = rate(False), rate(True)
    return [
        Figure("SDF queries with status", plain, "M points/s", at_least=2.5),
        Figure("SDF alone, times eager torch", ratio(False), "", at_least=6),
        Figure("SDF queries with gradient", steep, "M points/s"),
        Figure("SDF and gradient, share of the SDF rate", steep / plain, "", at_least=0.5),
        Figure("SDF and gradient alone, times eager torch", ratio(True), ""),
    ]


def _mesh_s(epoch: Epoch, made: DrivenStreet) -> float:
    lattice = tile_lattice(MeshSettings(), 0)
    tiles = surface_tiles(epoch, lattice)
    tiles = tiles[lattice.meets(tiles, *made.drive.scene.bounds)]

    def mesh_all() -> None:
        for x, y, z in tiles.tolist():
            mesh_tile(epoch, (x, y, z), lattice)

    return statistics.median(seconds(mesh_all) for _ in range(3))


def _publishing(mapper: Mapper) -> Figure:
    times = []
    for _ in range(_ROUNDS):
        mapper.train()
        times.append(seconds(mapper.publish))
    return Figure("publish an epoch", 1e3 * statistics.median(times), "ms")
