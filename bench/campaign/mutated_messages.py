"""Valid messages on every key, and mutants in which a few things are changed."""

import copy
import math
import random
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
from support import servers
from support.operations import OPERATIONS
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.mesh_messages import MeshRequest, TileChangesRequest, TileListRequest
from triquad_format.wire.messages import (
    CheckpointRequest,
    FlushRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
    Scan,
    SdfRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest
from triquad_format.wire.query_messages import (
    AlignRequest,
    ChangesRequest,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)
from triquad_format.wire.source_messages import CorrectPosesRequest, SourcesRequest
from triquad_format.wire.status_messages import StatusRequest

NUMBERS = (0, 1, -1, 2, 7, 2**15, 2**31, -(2**31), 2**53, 2**62, 2**63 - 1, -(2**63), 2**64 - 1)
_VALUES: tuple[Any, ...] = (
    *NUMBERS, 0.0, -0.0, 0.5, 1e-300, 1e9, 1e300, -1e300, math.nan, math.inf, -math.inf, True, None,
    "", "x", "../../x", "\x1b[2J", "a" * 300, b"", b"\0" * 12, [], {}, [[]], [0] * 40,
    {"dtype": "<f4", "shape": [0, 3], "data": b""},
    {"dtype": "<f4", "shape": [2**40, 0], "data": b""},
    {"dtype": "|O", "shape": [1], "data": b"\0" * 8},
)  # fmt: skip
_SHARE_OF_SCANS = 0.25
_ORIGIN = np.zeros(3)
_BOX = (np.full(3, -6.0), np.full(3, 6.0))


def good_requests() -> dict[str, list[Message]]:
    """Return a few requests that are answered, for each operation that is known here."""
    some = servers.sphere(20)
    way = some / np.linalg.norm(some, axis=1, keepdims=True)
    tiles = np.array([[-1, 0, 0], [0, 0, 0]], np.int32)
    return {
        keys.SDF: [SdfRequest(_ORIGIN, some, True, 0)],
        keys.DISTANCE: [DistanceRequest(_ORIGIN, some, 5.0, True, True, 0)],
        keys.SPHERES: [SpheresRequest(_ORIGIN, some, np.ones(20, np.float32), 0)],
        keys.SEGMENTS: [SegmentsRequest(_ORIGIN, some, -some, 0.2, 5.0, 0)],
        keys.RAYS: [RaysRequest(_ORIGIN, some * 0, way, 20.0, True, 0)],
        keys.GROUND: [GroundRequest(_ORIGIN, some, 5.0, 0)],
        keys.GRID: [GridRequest(_ORIGIN, 0.5, np.array([4, 4, 4], np.int32), 5.0, 0)],
        keys.ALIGN: [AlignRequest(some, np.eye(4), 1.0, 0)],
        keys.CHANGES: [ChangesRequest(1, "", *_BOX)],
        keys.SOURCES: [SourcesRequest("", 0, 10)],
        keys.TILE_LIST: [TileListRequest(*_BOX, 0)],
        keys.MESH: [MeshRequest(tiles, 0, level) for level in (0, 1, 2)],
        keys.TILE_CHANGES: [TileChangesRequest(*_BOX, 0, "", 0)],
        keys.STATUS: [StatusRequest()],
        keys.METRICS: [MetricsRequest()],
        keys.FLUSH: [FlushRequest("lidar", 7, 0, 0.2)],
        keys.MAP_INFO: [MapInfoRequest(False), MapInfoRequest(True)],
        keys.MAP_CHUNK: [MapChunkRequest("0" * 64, 0, 1000)],
        keys.CHECKPOINT: [CheckpointRequest()],
        keys.RESET: [ResetRequest(*_BOX)],
        keys.CORRECT_POSES: [
            CorrectPosesRequest("lidar", np.arange(2), np.ones((2, 3)), np.eye(4)[2:], True)
        ],
    }


class MutatedMessages:
    """Draws mutants of valid messages, and the keys that they are sent to."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._sequence = 0
        requests = good_requests()
        self._requests = {key: [codec.encode(m) for m in good] for key, good in requests.items()}
        self._all = [payload for good in self._requests.values() for payload in good]

    def scan(self) -> bytes | None:
        """Return a mutated scan of the source ``lidar``; ``None`` where a request is due."""
        if self._chance.random() > _SHARE_OF_SCANS:
            return None
        self._sequence += 1
        points = servers.sphere(self._chance.choice((1, 50, 300)))
        no_return = points[:5] if self._chance.random() < 0.3 else None
        good = Scan(points, np.eye(4), self._sequence, "lidar", 7, self._sequence, no_return)
        return self._mutated(codec.encode(good))

    def request(self) -> tuple[str, bytes]:
        """Return an operation, and a request that may be meant for it."""
        operation = self._chance.choice(OPERATIONS)
        own = self._requests.get(operation, self._all)
        return operation, self._mutated(
            self._chance.choice(own if self._chance.random() < 0.95 else self._all)
        )

    def _mutated(self, payload: bytes) -> bytes:
        how = self._chance.random()
        if how < 0.2:
            return self._other_bytes(payload)
        if how < 0.9:
            body = msgpack.unpackb(payload)
            if how < 0.6:
                for _ in range(self._chance.choice((1, 1, 2, 4))):
                    if places := [*_values(body)]:  # all may have been left out by now
                        self._replace(*self._chance.choice(places))
            else:
                self._nudge(body)
            return bytes(msgpack.packb(body))
        return payload

    def _other_bytes(self, payload: bytes) -> bytes:
        chance = self._chance
        how, at = chance.randrange(4), chance.randrange(len(payload) + 1)
        if how == 0:
            return payload[:at]
        if how == 1:
            return payload[:at] + chance.randbytes(chance.randrange(1, 30)) + payload[at:]
        if how == 2:
            return chance.randbytes(chance.randrange(200))
        changed = bytearray(payload)
        for _ in range(chance.randrange(1, 9)):
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
        return bytes(changed)

    def _nudge(self, body: dict[str, Any]) -> None:
        """Change the numbers and flags of a message a little: most mutants are still answered."""
        for key, value in body.items():
            if key == "triquad" or self._chance.random() < 0.5:
                continue
            if isinstance(value, bool):
                body[key] = not value
            elif isinstance(value, int):
                body[key] = value + self._chance.randrange(-1, 3)
            elif isinstance(value, float):
                body[key] = value * self._chance.uniform(0.1, 3.0)
            elif isinstance(value, dict) and value.get("dtype") in ("<f4", "<f8"):
                numbers = np.frombuffer(value["data"], value["dtype"])
                times = numbers.dtype.type(self._chance.uniform(-2, 2))
                body[key] = value | {"data": (numbers * times).tobytes()}

    def _replace(self, within: Any, key: Any) -> None:
        """Change a value to anything, or leave it out."""
        value, chance = within[key], self._chance
        if isinstance(value, bytes) and value and chance.random() < 0.9:
            within[key] = self._other_numbers(value)
        elif isinstance(within, dict) and chance.random() < 0.1:
            del within[key]
        else:
            within[key] = copy.deepcopy(chance.choice(_VALUES))

    def _other_numbers(self, data: bytes) -> bytes:
        """Return an array in which some of the numbers are changed."""
        size = 8 if len(data) % 8 == 0 else 4 if len(data) % 4 == 0 else 1
        numbers = np.frombuffer(data, {8: "<f8", 4: "<f4", 1: "|u1"}[size]).copy()
        places = [self._chance.randrange(len(numbers)) for _ in range(self._chance.choice((1, 9)))]
        odd = (0.0, -1.0, 1e-30, 30.0, 1e4, 1e9, 3e38, math.nan, math.inf, -math.inf)
        if size == 1:
            numbers[places] = self._chance.randrange(256)
        else:
            numbers[places] = self._chance.choice(odd)
        return numbers.tobytes()


def _values(body: Any) -> Iterator[tuple[Any, Any]]:
    """Find what can be changed of a message: the container and the key of each value in it."""
    for key, value in [*body.items()] if isinstance(body, dict) else [*enumerate(body)]:
        yield body, key
        if isinstance(value, (dict, list)):
            yield from _values(value)
