"""Mutated map files, against all that reads them, in a child that is watched."""

import contextlib
import io
import itertools
import multiprocessing
import os
import signal
from multiprocessing.connection import Connection
from pathlib import Path

from fuzz.mutants import DAMAGE, FORGERY, Mutation, cut, flip_bits
from fuzz.reading import REFUSED, in_its_place, read_in_every_way
from fuzz.valid_maps import ValidMap, valid_maps
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from triquad_tools.commands import inspect

from bench.campaign.turn import Turn

_START_S = 120.0
"""Time for a child to import all that reads files, and to make valid ones."""
_HANG_S = 20.0
_MUTATIONS = (*DAMAGE, *FORGERY)
_READ, _ENDED = "read", "ended"
_CHUNK = 50  # mutants between two checks of the time


def run(turn: Turn) -> None:
    """Read mutants in a child, which is replaced where it dies or hangs."""
    part = 0
    while not turn.over:
        _run_child(turn, part)
        part += 1


def _run_child(turn: Turn, part: int) -> None:
    """Run one child on its files, until it has ended in any way."""
    # A forked child would wait for ever for the threads that compute in this process.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_read_mutants, args=(turn, part, theirs))
    child.start()
    theirs.close()
    try:
        ours.poll(_START_S)
        while ours.poll(_HANG_S):
            what, text = ours.recv()
            if what == _ENDED:
                child.join()
                return
            turn.did(what)
            if text:
                turn.broke(text)
        turn.broke(f"part {part}: a file was not read within {_HANG_S:g} s")
    except EOFError:
        child.join()
        turn.broke(f"part {part}: the reading process ended with {child.exitcode}")
    finally:
        if child.is_alive():
            os.kill(child.pid or 0, signal.SIGKILL)
        child.join()
    turn.did("broken")


def _read_mutants(turn: Turn, part: int, tell: Connection) -> None:
    """Run a child: draw mutants, and report the outcome of each."""
    folder = turn.folder / f"files-{part}"
    folder.mkdir()
    maps = valid_maps(folder)

    for chunk in itertools.count():
        _read_chunk(turn, maps, (turn.seed, part, chunk), tell)
        if turn.over:
            break
    tell.send((_ENDED, ""))


def _read_chunk(
    turn: Turn, maps: list[ValidMap], seeds: tuple[int, int, int], tell: Connection
) -> None:
    """Read some mutants, which follow from the seeds alone."""

    @seed(repr(seeds))
    @settings(
        max_examples=min(_CHUNK, turn.most - turn.counts["done"]),
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def read_one(data: st.DataObject) -> None:
        tell.send(_outcome(maps, data))
        turn.did(_READ)

    read_one()


def _outcome(maps: list[ValidMap], data: st.DataObject) -> tuple[str, str]:
    """Return the outcome of a mutant, and what broke, if anything did."""
    valid = data.draw(st.sampled_from(maps))
    name = data.draw(st.sampled_from(sorted(valid.files)))
    # Those of a store have other checksums: a forgery would be damage.
    in_store = not name.endswith(".triquad")
    mutation: Mutation = data.draw(st.sampled_from((flip_bits, cut) if in_store else _MUTATIONS))
    mutant = mutation(data.draw, valid.files[name])
    try:
        with in_its_place(valid, name, mutant):
            what = read_in_every_way(valid, forged=mutation in FORGERY)
            _inspect(valid.path, readable=what != REFUSED)
    except Exception as error:
        kept = valid.path.parent.parent / f"broken-{Path(name).name}-{abs(hash(mutant)):x}"
        kept.write_bytes(mutant)
        how = f"{valid}, {mutation.__name__}: {type(error).__name__}: {error}"
        return "broken", f"{how:.900}; the file is {kept.name}"
    return what, ""


def _inspect(path: Path, *, readable: bool) -> None:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = inspect.main([str(path)])
    assert status in (0, 1, 2), f"triquad-inspect ended with {status}"
    assert status == 0 or not readable, f"triquad-inspect refuses it: {printed.getvalue()}"
