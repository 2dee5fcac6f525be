"""Spoil map files in every way that comes to mind, and see that the readers mind all of them.

Run as ``python -m triquad_tools.fuzz_maps [--count N] [--seed S] [FILE ...]``. Each spoilt file is
read whole and by random access. It must read back as it was (or, where all digests were made to
fit, as a sound map), or be refused by an error of the format; within 5 s, and within 64 MiB beside
what the process takes for sound maps. The address space is limited to that, so no allocation can
pass unseen; files that unpack to much, and one of 50 others, are also measured by ``tracemalloc``.
Linux only.
"""

import argparse
import dataclasses
import functools
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np
from triquad_format.errors import FormatError, NoIndexError
from triquad_format.mapfile import read_map
from triquad_format.record_check import check_record
from triquad_format.region import MapRecord
from triquad_format.stored_map import StoredMap

from triquad_tools.arguments import count, not_negative, seed
from triquad_tools.map_mutations import MUTATIONS, Mutant
from triquad_tools.sound_maps import SoundMap, sound_maps

_LIMIT_BYTES = 64 * 2**20
_TRACED_EACH = 50
_COLUMN = 17  # width of a column of the table
_POINT = np.array([[0.3, 0.2, 0.1]])
_BOX = ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])

Results = tuple[object, ...]
"""What a reader made of a file."""


class TooSlowError(BaseException):
    """A reader took longer than it may; no reader catches it."""


class WrongError(Exception):
    """A reader gave what it must not."""


@dataclass
class Tally:
    """What became of the mutants of one kind."""

    outcomes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    most_bytes: int = 0  # of those that were measured


@dataclass(frozen=True)
class Trial:
    """A map of which a file is to be spoilt, and how."""

    rng: random.Random
    sound: SoundMap
    kind: str  # of MUTATIONS
    traced: bool  # whether the memory that reading takes is measured


@dataclass(frozen=True)
class Reader:
    """A way of reading a file, and what it gives for each sound one."""

    name: str
    read: Callable[[Path], Results]
    sound: dict[str, Results]  # empty where it cannot read them


def main(arguments: list[str] | None = None) -> int:
    """Run; 1 where a reader failed."""
    options = _parser().parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        maps = sound_maps(Path(folder), options.files)
        readers = [
            Reader(name, read, {sound.kind: _of_sound(read, sound) for sound in maps})
            for name, read in (("whole", _read_whole), ("indexed", _read_indexed))
        ]
        with np.errstate(all="ignore"):
            return _run(options, maps, readers)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m triquad_tools.fuzz_maps")
    parser.add_argument("--count", type=count, default=10_000, help="spoilt files")
    parser.add_argument("--seed", type=seed, default=0, help="each gives other files")
    parser.add_argument("--first", type=seed, default=0, help="number of the first of them")
    parser.add_argument("--limit", type=not_negative, default=5.0, help="s for a file; 0: any")
    parser.add_argument("files", type=Path, nargs="*", help="more sound map files to spoil")
    return parser


def _run(options: argparse.Namespace, maps: list[SoundMap], readers: list[Reader]) -> int:
    tallies = {name: Tally() for name in MUTATIONS}
    begun = time.monotonic()
    largest = max(len(data) for sound in maps for data in sound.files.values())
    watch = Watch(options.limit, largest)
    for number in range(options.first, options.first + options.count):
        trial = _trial(options.seed, number, maps)
        try:
            _try_one(trial, readers, tallies[trial.kind], watch)
        except (Exception, TooSlowError) as error:
            traceback.print_exc()
            again = f"--seed {options.seed} --first {number} --count 1"
            print(" ".join([f"{trial.kind}: {error!r}; again:", again, *map(str, options.files)]))
            return 1
    _print_table(tallies, time.monotonic() - begun)
    return 0


def _trial(seed: int, number: int, maps: list[SoundMap]) -> Trial:
    rng = random.Random(f"{seed} {number}")
    kind = rng.choices(list(MUTATIONS), [share for _, share in MUTATIONS.values()])[0]
    traced = kind == "bombs" or number % _TRACED_EACH == 0
    return Trial(rng, rng.choice(maps), kind, traced)


class Watch:
    """Sees what a reader takes."""

    def __init__(self, limit_s: float, file_bytes: int) -> None:
        """Begin.

        Args:
            limit_s: what a reader may take; 0: any time.
            file_bytes: size of the largest sound file, all of which were read before.
        """
        self._limit_s = limit_s
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        self._limit_bytes = pages * resource.getpagesize() + _LIMIT_BYTES + file_bytes
        self._hard_limit = resource.getrlimit(resource.RLIMIT_AS)[1]
        signal.signal(signal.SIGALRM, self._too_slow)

    def limited(self, tally: Tally, read: Callable[[], str]) -> None:
        """Note what came of it; the address space is limited."""
        resource.setrlimit(resource.RLIMIT_AS, (self._limit_bytes, self._hard_limit))
        try:
            self._timed(tally, read)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (self._hard_limit, self._hard_limit))

    def traced(self, tally: Tally, size: int, read: Callable[[], str]) -> None:
        """Note what came of it, and how much memory it took; tracing takes some itself."""
        tracemalloc.start()
        try:
            self._timed(tally, read)
            most = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        tally.most_bytes = max(tally.most_bytes, most)
        if most > _LIMIT_BYTES + size:
            raise WrongError(f"it took {most} bytes; the file has {size}")

    def _timed(self, tally: Tally, read: Callable[[], str]) -> None:
        begun = time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, self._limit_s)
        try:
            tally.outcomes[read()] += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        tally.slowest_s = max(tally.slowest_s, time.perf_counter() - begun)

    def _too_slow(self, _number: int, _frame: FrameType | None) -> None:
        raise TooSlowError(f"it took more than {self._limit_s:g} s")


def _try_one(trial: Trial, readers: list[Reader], tally: Tally, watch: Watch) -> None:
    """Spoil one file of a map, and read the map in each way."""
    sound = trial.sound
    name = trial.rng.choice(list(sound.files))
    mutant = MUTATIONS[trial.kind][0](trial.rng, sound.files[name])
    # Of another file a map knows the digest: no forgery of it passes.
    mutant = dataclasses.replace(mutant, forged=mutant.forged and name == sound.name)
    (sound.folder / name).write_bytes(mutant.data)
    for reader in readers:
        read = functools.partial(_outcome, reader, sound, mutant)
        if trial.traced:
            watch.traced(tally, len(mutant.data), read)
        else:
            watch.limited(tally, read)
    (sound.folder / name).write_bytes(sound.files[name])


def _outcome(reader: Reader, sound: SoundMap, mutant: Mutant) -> str:
    """What a reader makes of a spoilt file."""
    try:
        results = reader.read(sound.path)
    except FormatError as error:
        if isinstance(error.__cause__, MemoryError):
            raise WrongError(f"{reader.name}: it takes too much memory") from error
        if not str(error).strip():
            raise WrongError(f"{reader.name}: {type(error).__name__} without a text") from error
        return type(error).__name__
    if _same(results, reader.sound[sound.kind]):
        return "as it was"
    if not mutant.forged:
        raise WrongError(f"{reader.name}: it is read as another map")
    for record in results:
        if isinstance(record, MapRecord):
            check_record(record)
    return "another sound map"


def _of_sound(read: Callable[[Path], Results], sound: SoundMap) -> Results:
    try:
        return read(sound.path)
    except NoIndexError:
        return ()


def _read_whole(path: Path) -> Results:
    return (read_map(path),)


def _read_indexed(path: Path) -> Results:
    with StoredMap.open(path) as stored:
        return stored.query(_POINT, gradient=True), stored.box(*_BOX)


def _same(one: object, other: object) -> bool:
    """Whether all values are equal, those of arrays in dtype, too."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, one.dtype.kind == "f")
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        names = [part.name for part in dataclasses.fields(one)]
        return all(_same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


def _print_table(tallies: dict[str, Tally], seconds: float) -> None:
    reads = sum(sum(tally.outcomes.values()) for tally in tallies.values())
    classes = sorted({name for tally in tallies.values() for name in tally.outcomes})
    titles = [name.replace("MapFileError", "").replace("Error", "") or "no map" for name in classes]
    print(f"{'spoilt':11}" + "".join(f" {title:>{_COLUMN}}" for title in titles), end="")
    print("   slowest  memory")
    for kind, tally in tallies.items():
        columns = "".join(f" {tally.outcomes[name]:{_COLUMN}}" for name in classes)
        most = tally.most_bytes / 2**20
        print(f"{kind:11}{columns} {1e3 * tally.slowest_s:6.0f} ms {most:3.0f} MiB")
    print(f"{reads // 2} files, each read in two ways, in {seconds:.0f} s: no reader failed")


if __name__ == "__main__":
    sys.exit(main())
