"""Lies of a server, each with the question that it is the answer to."""

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from support.attackers.hostile_server import Body, packed
from support.files.file_damage import flipped
from triquad_client import Client
from triquad_format.wire import keys
from triquad_format.wire.tile_codec import TileSurface, encode_tile

COUNT = 100
POINTS = np.random.default_rng(1).normal(size=(COUNT, 3))
BOX = ((0, 0, 0), (1, 1, 1))
AROUND = ((-9, -9, -9), (9, 9, 9))
NOWHERE = ((90, 90, 90), (91, 91, 91))
NAN, INF = float("nan"), float("inf")
SURFACE = TileSurface(
    np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.uint16),
    np.zeros(3, np.uint8),
    np.zeros(3, np.uint8),
    faces=np.array([(0, 1, 2)], np.int32),
)
TILE = encode_tile(SURFACE)

Ask = Callable[[Client, Path], object]


@dataclass(frozen=True)
class Lie:
    """What a server changes of its replies to an operation."""

    name: str
    operation: str
    change: Callable[[Body], object]
    ask: Ask


def all_values(value: float, dtype: str = "<f4", shape: tuple[int, ...] = (COUNT,)) -> Body:
    return packed(np.full(shape, value), dtype)


def _sets(**fields: object) -> Callable[[Body], object]:
    return lambda body: body.update(fields)


def _within(path: str, **fields: object) -> Callable[[Body], object]:
    """The fields of a message inside a message; ``path`` is of names with slashes between."""

    def change(body: Body) -> None:
        for name in path.split("/"):
            body = body[name] if name != "*" else next(iter(body.values()))
        body.update(fields)

    return change


def _flush(client: Client, _: Path) -> object:
    client.publish_scan(POINTS, np.eye(4))
    return client.flush(9.0)


def _correct(client: Client, _: Path) -> object:
    stamp_s = time.time()
    client.publish_scan(POINTS, np.eye(4), stamp_s)
    client.flush(9.0)
    return client.correct_poses("default", [stamp_s], [np.eye(4)])


def _watch(client: Client, _: Path) -> object:
    with client.watch_mesh() as watch:
        return watch.next(0.0)


def _watch_on(client: Client, _: Path) -> object:
    """A second update, after an honest first one."""
    with client.watch_mesh() as watch:
        watch.next(0.0)
        return watch.next(0.0)


def _sources_on(client: Client, _: Path) -> object:
    return client.sources(client.sources())


def _second(change: Callable[[Body], object]) -> Callable[[Body], object]:
    """Honest at first."""
    answered: list[bool] = []

    def lie(body: Body) -> None:
        if answered:
            change(body)
        answered.append(True)

    return lie


def _pinned(client: Client, _: Path) -> object:
    return client.query_sdf(POINTS, at_epoch=client.status().epoch)


def _questions() -> dict[str, tuple[str, Ask]]:
    return {
        "sdf": (keys.SDF, lambda client, _: client.query_sdf(POINTS)),
        "gradient": (keys.SDF, lambda client, _: client.query_sdf(POINTS, gradient=True)),
        "sdf of epoch": (keys.SDF, _pinned),
        "distance": (
            keys.DISTANCE,
            lambda client, _: client.query_distance(
                POINTS, surface_point=True, unknown_distance=True
            ),
        ),
        "spheres": (keys.SPHERES, lambda client, _: client.query_spheres(POINTS, 0.5)),
        "segments": (keys.SEGMENTS, lambda client, _: client.query_segments(POINTS, -POINTS)),
        "rays": (keys.RAYS, lambda client, _: client.query_rays((0, 0, 0), POINTS)),
        "ground": (keys.GROUND, lambda client, _: client.query_ground(POINTS)),
        "grid": (keys.GRID, lambda client, _: client.query_grid(BOX, 0.25)),
        "align": (keys.ALIGN, lambda client, _: client.align(POINTS, np.eye(4))),
        "changes": (keys.CHANGES, lambda client, _: client.changes(client.status().epoch)),
        "sources": (keys.SOURCES, lambda client, _: client.sources(max_points=10)),
        "sources again": (keys.SOURCES, _sources_on),
        "tiles": (keys.TILE_LIST, lambda client, _: client.mesh()),
        "mesh": (keys.MESH, lambda client, _: client.mesh()),
        "filled mesh": (keys.MESH, lambda client, _: client.mesh(fill_m=1.0)),
        "watch": (keys.TILE_CHANGES, _watch),
        "watch again": (keys.TILE_CHANGES, _watch_on),
        "watched tiles": (keys.MESH, _watch),
        "status": (keys.STATUS, lambda client, _: client.status()),
        "metrics": (keys.METRICS, lambda client, _: client.metrics()),
        "flush": (keys.FLUSH, _flush),
        "checkpoint": (keys.CHECKPOINT, lambda client, _: client.checkpoint()),
        "reset": (keys.RESET, lambda client, _: client.reset(NOWHERE)),
        "correct poses": (keys.CORRECT_POSES, _correct),
        "download": (keys.MAP_INFO, lambda client, path: client.download_map(path)),
        "chunk": (keys.MAP_CHUNK, lambda client, path: client.download_map(path)),
        "copy": (keys.MAP_CHUNK, lambda client, path: client.sync(AROUND, path)),
    }


QUESTIONS = _questions()


def _adds(field: str, more: Any) -> Callable[[Body], object]:
    return lambda body: body.update({field: body[field] + more})


def _rots(body: Body) -> None:
    """A bit is flipped in each kilobyte."""
    body["data"] = flipped(body["data"], *range(0, len(body["data"]), 1000))


def _has_faces(faces: list[list[int]]) -> Callable[[Body], object]:
    """A reply of one tile with these faces."""
    tile = encode_tile(replace(SURFACE, faces=np.array(faces, np.int32)))
    return _sets(data=tile, sizes=packed([len(tile)], "<i8"))


_LIES: list[tuple[str, str, Callable[[Body], object]]] = [
    ("sdf", "no status", lambda body: body.pop("status")),
    ("sdf", "2^39 values declared", lambda body: body["sdf"].update(shape=[2**39])),
    ("sdf", "another kind", _sets(kind="DistanceReply")),
    ("sdf of epoch", "another epoch", _adds("epoch", 1)),
    ("gradient", "no gradient", _sets(gradient=None)),
    ("distance", "no number", _sets(distance_m=all_values(NAN))),
    ("distance", "beyond what was asked", _sets(distance_m=all_values(80))),
    ("distance", "long gradient", _sets(gradient=all_values(100, shape=(COUNT, 3)))),
    ("rays", "beyond what was asked", _sets(range_m=all_values(900))),
    ("align", "no pose", _sets(world_from_sensor=packed(np.ones((4, 4)), "<f8"))),
    ("align", "a thousand million steps", _sets(iterations=10**9)),
    ("changes", "since another epoch", _adds("since", 1)),
    ("changes", "boxes without corners", _sets(voxels=packed([3], "<i8"))),
    ("sources", "too many points", _within("sources/*/newest",
                                           points=all_values(0, shape=(5000, 3)))),
    ("sources", "no pose", _within("sources/*/newest",
                                   world_from_sensor=all_values(0, "<f8", (4, 4)))),
    ("sources", "nothing is new", _sets(sources=None)),
    ("sources again", "of another revision", _second(_sets(sources=None, revision=0))),
    ("tiles", "no side", _sets(tile_side_m=0.0)),
    ("mesh", "corner that is not there", _has_faces([[0, 1, 99]])),
    ("mesh", "half a tile", _sets(data=TILE[:9], sizes=packed([9], "<i8"))),
    ("mesh", "side 1e30 m", _sets(tile_side_m=1e30)),
    ("mesh", "marks unasked", _sets(filled=packed([0], "|u1"))),
    ("mesh", "more bytes than told", _adds("data", b"x")),
    ("mesh", "another epoch", _adds("epoch", 1)),
    ("filled mesh", "without marks", _sets(filled=None)),
    ("filled mesh", "more marks than faces", _sets(filled=packed([0, 1, 0], "|u1"))),
    ("watch again", "turns back", _second(_sets(epoch=0))),
    ("watched tiles", "sizes that are too large", _sets(sizes=packed([2**40], "<i8"))),
    ("status", "long names", _sets(device="x" * 60_000)),
    ("checkpoint", "no digest", _sets(sha256="../../etc/passwd")),
    ("download", "2^62 bytes", _sets(bytes=2**62)),
    ("download", "chunks of 0 bytes", _sets(chunk_bytes=0)),
    ("chunk", "more than was asked", lambda body: body.update(data=body["data"] * 2)),
    ("chunk", "other bytes", _rots),
    ("copy", "other bytes", _rots),
    ("copy", "from elsewhere", _adds("offset", 1)),
]  # fmt: skip

LIES = [
    Lie(f"{asked}: {name}", QUESTIONS[asked][0], change, QUESTIONS[asked][1])
    for asked, name, change in _LIES
]


def out_of_bounds(body: Any, name: str = "") -> Iterator[tuple[str, Callable[[], object]]]:
    """What would put one value of a reply, or of a message in it, out of any bounds; by its name.

    An array that is no longer as long as what it goes with is one, too. Of a map, one item is
    changed: the others have the same bounds.
    """
    is_message = any(not isinstance(value, dict) for value in body.values())
    for key, value in list(body.items())[: None if is_message else 1]:
        where = f"{name}/{key}"
        if isinstance(value, dict) and "dtype" in value:
            array = np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"])
            bad = {"f": INF, "i": -(2**31), "u": 200}[array.dtype.kind]
            if array.size:
                wrong = packed(np.full_like(array, bad), value["dtype"])
                yield where, functools.partial(body.update, {key: wrong})
                fewer = packed(array[1:], value["dtype"])
                yield f"{where}, shorter", functools.partial(body.update, {key: fewer})
        elif isinstance(value, dict):
            yield from out_of_bounds(value, where)
        elif isinstance(value, float):
            yield where, functools.partial(body.update, {key: NAN})
        elif isinstance(value, int) and not isinstance(value, bool):
            yield where, functools.partial(body.update, {key: -5})
