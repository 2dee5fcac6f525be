"""How mutants are read: as the map that it was, as another valid map, or they are refused by name.

Linux only: memory is limited.
"""

import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from fuzz.valid_maps import READERS, Results, ValidMap
from support.maps.map_records import assert_same
from triquad_format.errors import FormatError
from triquad_format.mapfile.record_check import check_record
from triquad_format.records.region import MapRecord
from triquad_tools.mapfiles.recovery import recover

REFUSED = "refused"
_LIMIT_BYTES = 64 * 2**20
"""Memory that a reader may take in addition to the size of the file."""


@contextmanager
def in_its_place(valid: ValidMap, name: str, mutant: bytes) -> Iterator[Path]:
    """Have a mutant instead of one of the files of a map, with little memory to read it."""
    file = valid.path.parent / name
    file.write_bytes(mutant)
    try:
        with little_memory(len(mutant)), np.errstate(all="ignore"):
            yield file
    finally:
        file.write_bytes(valid.files[name])


def read_in_every_way(valid: ValidMap, *, forged: bool) -> str:
    """Read a map of which a file is a mutant; return what became of it.

    Raises:
        AssertionError: it passed for what it is not, or took too much memory.
        Exception: whatever a reader lets out and should not.
    """
    outcomes = set()
    for read, wanted in zip(READERS, valid.results, strict=True):
        try:
            have = read(valid.path)
        except FormatError as error:
            _check_refusal(error)
            outcomes.add(REFUSED)
            continue
        if _is_same(have, wanted):
            outcomes.add("as it was")
        else:
            assert forged, f"{read.__name__}: it is read as another map"
            for record in have:
                if isinstance(record, MapRecord):
                    check_record(record)
            outcomes.add("another valid map")
    with suppress(FormatError):
        check_record(recover(valid.path).record)
    return REFUSED if REFUSED in outcomes else min(outcomes)


def _check_refusal(error: FormatError) -> None:
    assert not isinstance(error.__cause__, MemoryError), "it takes too much memory"
    assert str(error).strip(), "an error without a text"


def _is_same(results: Results, wanted: Results) -> bool:
    try:
        assert_same(results, wanted)
    except AssertionError:
        return False
    return True


@contextmanager
def little_memory(file_bytes: int) -> Iterator[None]:
    """Limit the address space of this process, so that no allocation passes unseen."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + _LIMIT_BYTES + file_bytes
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
