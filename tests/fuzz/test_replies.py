"""Replies that are wrong at random: a client takes them as answers or refuses them, no third way.

``TRIQUAD_FUZZ_REPLIES`` is how many mutants are sent.
"""

import math
import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import triquad_client
from support.hostile_server import HostileServer, hostile_server
from support.lies import COUNT, QUESTIONS
from triquad_client import Client, Mesh
from triquad_format.errors import TriquadError

MUTANTS = int(os.environ.get("TRIQUAD_FUZZ_REPLIES", "1500"))
SEED = int(os.environ.get("TRIQUAD_FUZZ_SEED", "1"))

_VALUES = [
    None, True, -1, 0, 1, 2**31, 2**53 + 1, 2**62, -(2**63), 0.5, math.nan, math.inf, -1e308,
    "", "x", "\x1b[2J", "9" * 5000, b"", b"\xff" * 7, [], [1, 2], {}, {"a": 1},
    {"dtype": "<f4", "shape": [2**39], "data": b""},
    {"dtype": "<f4", "shape": [1], "data": b"1234"},
    {"dtype": "|u1", "shape": [3], "data": b"\x01\x02\x09"},
]  # fmt: skip


@pytest.fixture(scope="module")
def connected() -> Iterator[tuple[HostileServer, Client]]:
    with (
        hostile_server() as server,
        triquad_client.connect(server.endpoint, timeout_s=5.0, max_download_bytes=2**20) as client,
    ):
        yield server, client


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_mutant_is_an_answer_or_is_refused(
    connected: tuple[HostileServer, Client], name: str, tmp_path: Path
) -> None:
    server, client = connected
    choice = random.Random(f"{SEED} {name}")
    operation, ask = QUESTIONS[name]
    refusals = []
    for _ in range(MUTANTS // len(QUESTIONS)):
        server.lie = lambda asked, honest: mutant(honest, choice) if asked == operation else honest
        try:
            answer = ask(client, tmp_path / "map.triquad")
        except TriquadError as error:
            refusals.append(str(error))
        else:
            assert_answers(answer)
    assert all(map(str.isprintable, refusals)), SEED


def mutant(honest: bytes, choice: random.Random) -> bytes:
    """A reply with some bits flipped, cut short, or with other values in its fields."""
    how = choice.randrange(4)
    if how == 0:
        data = bytearray(honest)
        for _ in range(choice.randint(1, 4)):
            data[choice.randrange(len(data))] ^= 1 << choice.randrange(8)
        return bytes(data)
    if how == 1:
        return honest[: choice.randrange(len(honest))]
    body = msgpack.unpackb(honest)
    for _ in range(choice.randint(1, 2)):
        _change(body, choice)
    return msgpack.packb(body)


def _change(body: dict[str, Any], choice: random.Random) -> None:
    """Change a field, or one of a message or an array in it."""
    name = choice.choice([*body, "new"])
    inner = body.get(name)
    if isinstance(inner, dict) and inner and choice.random() < 0.6:
        _change(inner, choice)
    elif name in body and choice.random() < 0.2:
        del body[name]
    elif isinstance(inner, bytes) and inner and choice.random() < 0.8:
        values = choice.choice(["<f4", "<f8", "<i8", "|u1"])
        array = np.frombuffer(inner[: len(inner) // 8 * 8], values).copy()
        if array.size:
            with np.errstate(all="ignore"):
                array[choice.randrange(array.size)] = choice.choice([0, 3, 99, 255])
        body[name] = array.tobytes() + inner[len(inner) // 8 * 8 :]
    else:
        body[name] = choice.choice(_VALUES)


def assert_answers(answer: object) -> None:
    """What was taken can be used: as much as was asked for, statuses that exist, faces that fit."""
    status = getattr(answer, "status", None)
    if isinstance(status, np.ndarray):
        assert status.size in (COUNT, 64)
        assert status.max() <= 2
    epoch = getattr(answer, "epoch", 0)
    assert 0 <= epoch <= 2**53
    if isinstance(answer, Mesh):
        assert np.isfinite(answer.vertices).all()
        assert not answer.faces.size or answer.faces.max() < len(answer.vertices)
