"""``triquad-bench`` of the mesh: fetched, followed while one more scan comes, and joined later."""

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from triquad_client import Client, Mesh, MeshWatch
from triquad_format.records.arrays import Bools
from triquad_format.wire.tile_codec import decode_tile
from triquad_sensors.pose import moved
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.mesher import TileIndex, tile_lattice
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings, Settings

from triquad_tools.benchmarks.figures import Figure, seconds
from triquad_tools.benchmarks.served import latency_figures, served
from triquad_tools.benchmarks.street import BenchStreet, learn_all, settled_mapper
from triquad_tools.demo.probe import ask_until
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, publish_all, wait_until_settled
from triquad_tools.simulation.lidar import SimulatedScan

_SETTLE_LIMIT_S = 600.0
_FETCH_LIMIT_S = 300.0
_ASKED = 1_000
_NEEDLESS = 0.4  # of the tiles that are meshed again; where all are, or some at random, it is more
_NEXT = 50  # the scan that comes again, from half a metre on
_CANDIDATES = 8  # triangles that are tried for each point: those of the nearest centroids
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)


def measure_mesh(made: BenchStreet) -> list[Figure]:
    """Figures of tiles: through the network, and what is meshed again for a scan."""
    return _network(made) + _work(made)


def _network(made: BenchStreet) -> list[Figure]:
    with served() as server, server.another_client() as other:
        client = server.client
        publish_all(client, made.scans)
        wait_until_settled(client, _SETTLE_LIMIT_S)
        figures = _fetched(client)
        with client.watch_mesh() as early:
            early.catch_up(_FETCH_LIMIT_S)
            figures += _sizes(early)
            figures += _followed(client, early, _one_more(made))
            with other.watch_mesh() as late:
                late.catch_up(_FETCH_LIMIT_S)
                different = _differ(early, late)
        figures.append(Figure("tiles that a late joiner has otherwise", different, "", at_most=0))
        figures += _levels(client, other, made)
    return figures


def _fetched(client: Client) -> list[Figure]:
    """The whole street, as nobody has it yet, and again."""
    name = "mesh of the whole street"
    with client.watch_mesh() as watch:
        first = seconds(lambda: watch.catch_up(_FETCH_LIMIT_S))
    with client.watch_mesh() as watch:
        again = seconds(lambda: watch.catch_up(_FETCH_LIMIT_S))
        joined = seconds(watch.mesh)
    return [
        Figure(f"{name}, first fetch of its tiles", first, "s"),
        Figure(f"{name}, fetched by another watch", again, "s"),
        Figure(f"{name}, its tiles joined", joined, "s"),
    ]


def _sizes(watch: MeshWatch) -> list[Figure]:
    tiles = watch.tiles.values()
    sent = sum(tile.size_bytes for tile in tiles)
    raw = sum(tile.vertices.nbytes + tile.faces.nbytes for tile in tiles)
    return [
        Figure("tiles of the street", len(tiles), ""),
        Figure("all of them", sent / 1e6, "MB"),
        Figure("one of them", sent / len(tiles) / 1e3, "kB"),
        Figure("raw numbers, times that", raw / sent, "", at_least=4),
    ]


def _followed(client: Client, watch: MeshWatch, scan: SimulatedScan) -> list[Figure]:
    """What travels for one more scan, until the map is settled again."""
    sent = replies = 0
    changed: set[TileIndex] = set()
    client.publish_scan(scan.points, scan.world_from_sensor)
    client.flush(FLUSH_TIMEOUT_S)
    settled = False
    while not settled:
        settled = client.status().settled
        while (update := watch.next(0.0)) is not None:
            sent += update.size_bytes
            replies += 1
            changed.update(update.changed)
    size = sum(watch.tiles[index].size_bytes for index in changed if index in watch.tiles)
    return [
        Figure("one more scan: tiles that changed", len(changed), ""),
        Figure("one more scan: bytes sent", sent / 1e3, "kB"),
        Figure("the same, times those tiles' bytes", sent / max(1, size), "", at_most=2),
    ]


def _differ(early: MeshWatch, late: MeshWatch) -> int:
    mine, theirs = early.tiles, late.tiles
    shared = mine.keys() & theirs.keys()
    differ = sum(mine[index].digest != theirs[index].digest for index in shared)
    return differ + len(mine.keys() ^ theirs.keys())


def _levels(client: Client, planner: Client, made: BenchStreet) -> list[Figure]:
    """The other levels, which are meshed for the first time while a planner asks."""
    figures = []
    stop = threading.Event()
    points = np.random.default_rng(0).permutation(made.probes.near)[:_ASKED]
    with ThreadPoolExecutor(1) as beside:
        asking = beside.submit(ask_until, stop, planner, points, "gradient")
        for level in (1, 2):
            with client.watch_mesh(level=level) as watch:
                watch.catch_up(_FETCH_LIMIT_S)
                size = sum(tile.size_bytes for tile in watch.tiles.values())
            figures.append(Figure(f"the street on level {level}", size / 1e6, "MB"))
        stop.set()
        met = asking.result()
    name = "1,000 points with gradient while tiles are meshed"
    return figures + latency_figures(name, met)


def _one_more(made: BenchStreet) -> SimulatedScan:
    """A scan from between two others."""
    pose = made.scans[_NEXT].world_from_sensor.copy()
    pose[:3, 3] = (pose[:3, 3] + made.scans[_NEXT + 1].world_from_sensor[:3, 3]) / 2
    return made.drive.sensor.scan(made.drive.scene, pose, np.random.default_rng(0))


def _work(made: BenchStreet) -> list[Figure]:
    """What is meshed again for one more scan, in process, once it is learnt."""
    settings = Settings()
    mapper = settled_mapper("the street", made.scans, settings)
    cache = TileCache(settings.mesh, Teams().meshing)
    cache.refresh(mapper.publish())
    make_tiles(cache)
    whole = cache.tiles_made
    before = _meshes(cache)

    scan = _one_more(made)
    mapper.ingest(scan.points, scan.world_from_sensor)
    epoch = mapper.publish()
    refresh_s = seconds(lambda: cache.refresh(epoch))
    evidence = len(cache.delta(0, *EVERYWHERE, cache.revision, {}).to_make)
    learn_all(mapper)
    epoch = mapper.publish()
    cache.refresh(epoch)
    touched = len(cache.delta(0, *EVERYWHERE, cache.revision, {}).to_make)
    started = time.perf_counter()
    again = make_tiles(cache)
    made_s = time.perf_counter() - started
    meshed = cache.tiles_made - whole
    changed = _changed(before, epoch, settings.mesh)
    lattice = tile_lattice(settings.mesh, 0)
    ends = moved(scan.points, scan.world_from_sensor)
    hit = len(lattice.tiles_meeting(ends, ends, lattice.margin_m))
    return [
        Figure("tiles that may hold a surface", whole, ""),
        Figure("one more scan: tiles with its end points", hit, ""),
        Figure("one more scan: tiles with new evidence", evidence, ""),
        Figure("one more scan, learnt: tiles whose surface changed", touched, ""),
        Figure("the same and neighbours that no longer fit", len(again), ""),
        Figure("one more scan: tiles meshed again", meshed, ""),
        Figure("share of these whose triangles tell of no change",
               1 - len(again & changed) / max(1, meshed), "", at_most=_NEEDLESS),
        Figure("tiles left alone whose triangles would tell of one", len(changed - again), ""),
        Figure("one more scan: looking for what changed", refresh_s, "s"),
        Figure("one more scan: meshing", made_s, "s"),
    ]  # fmt: skip


def _meshes(cache: TileCache) -> dict[TileIndex, Mesh]:
    """All tiles of a cache that show what the map has, in the map frame."""
    lattice = cache.lattice(0)
    meshes = {}
    for tile in cache.delta(0, *EVERYWHERE, 0, {}).ready:
        data = cache.data(0, tile)
        assert data is not None, "the cache is too small for the street"
        surface = decode_tile(data)
        corner = np.array(tile.index) * lattice.tile_side_m
        meshes[tile.index] = Mesh(corner + surface.positions(lattice.cell_m), surface.faces)
    return meshes


def _changed(before: dict[TileIndex, Mesh], epoch: Epoch, settings: MeshSettings) -> set[TileIndex]:
    """Tiles whose surface is another one in an epoch, all meshed anew."""
    cache = TileCache(settings, Teams().meshing)
    cache.refresh(epoch)
    make_tiles(cache)
    return changed_tiles(
        before, _meshes(cache), tolerance_m=settings.tolerance_m, cell_m=settings.cell_m
    )


def make_tiles(cache: TileCache) -> set[TileIndex]:
    """Make the tiles that have to be made; returns which those were."""
    made: set[TileIndex] = set()
    while to_make := cache.delta(0, *EVERYWHERE, cache.revision, {}).to_make:
        for index in to_make:
            cache.make(0, index)
        made.update(to_make)
    return made


def changed_tiles(
    before: Mapping[TileIndex, Mesh],
    after: Mapping[TileIndex, Mesh],
    tolerance_m: float,
    cell_m: float,
) -> set[TileIndex]:
    """Tiles whose surface came, went or moved.

    That is where a vertex is farther than ``cell_m`` from all triangles of the other time, or more
    than half of them are farther than ``tolerance_m``. Triangles have to be about as large as
    cells. Vertices are in the map frame: those of neighbouring tiles count as well, so that nothing
    comes or goes where a surface crosses from one tile to the next.
    """

    def left(tiles: Mapping[TileIndex, Mesh], triangles: _Triangles) -> set[TileIndex]:
        found = set()
        for index, tile in tiles.items():
            moved = tile.vertices[triangles.farther(tile.vertices, tolerance_m)]
            if 2 * len(moved) > len(tile.vertices) or triangles.farther(moved, cell_m).any():
                found.add(index)
        return found

    return left(before, _Triangles(after)) | left(after, _Triangles(before))


class _Triangles:
    """The triangles of all tiles."""

    def __init__(self, tiles: Mapping[TileIndex, Mesh]) -> None:
        corners = [mesh.vertices[mesh.faces] for mesh in tiles.values()]
        self._corners = np.concatenate([np.zeros((0, 3, 3)), *corners])  # [F, 3, 3]
        self._tree = cKDTree(self._corners.mean(axis=1))

    def farther(self, points: NDArray[np.floating], limit_m: float) -> Bools:
        """Whether points [N, 3] are farther from the triangles."""
        from trimesh.triangles import closest_point  # slow to import

        far = np.ones(len(points), np.bool_)
        count = min(_CANDIDATES, len(self._corners))
        if count == 0 or len(points) == 0:
            return far
        _, candidates = self._tree.query(points, range(1, count + 1), workers=-1)
        for rows in candidates.T:
            left = np.flatnonzero(far)
            corners = self._corners[rows[left]]
            nearest = closest_point(corners, points[left])
            far[left] = np.linalg.norm(nearest - points[left], axis=1) > limit_m
        return far
