"""Which checkpoints stay."""

import dataclasses

from triquad_server.settings import StoreSettings
from triquad_server.store.retention import StoredCheckpoint, staying


def checkpoints(*files: str) -> list[StoredCheckpoint]:
    """One for each text, the newest first: the names of its files, and ! where it undoes a reset.

    Each file has 10 bytes.
    """
    return [
        StoredCheckpoint(
            dict.fromkeys(names.strip("!"), 10), undoes="a reset" if "!" in names else ""
        )
        for names in files
    ]


def left(found: list[StoredCheckpoint], **settings: int) -> str:
    """The files of those that stay."""
    stay = staying(found, StoreSettings(**settings))
    return "".join(sorted({name for one in stay for name in one.files}))


def test_the_newest_stay() -> None:
    found = checkpoints("fa", "e", "d", "c")
    assert left(found, keep=2) == "aef"
    assert left(found, keep=3) == "adef"
    assert left(found, keep=9) == "acdef"


def test_bytes_are_counted_once_and_two_stay_in_any_case() -> None:
    found = checkpoints("fa", "ea", "da", "ca", "b")
    assert left(found, keep_bytes=40) == "adef"
    assert left(found, keep_bytes=50) == "acdef"
    assert left(found, keep_bytes=1) == "aef"


def test_what_undoes_resets_stays_beyond_the_newest() -> None:
    found = checkpoints("f", "e", "d!", "c", "b!", "a!")
    assert left(found, keep=2) == "abdef"
    assert left(found, keep=2, keep_resets=2) == "bdef"
    assert left(found, keep=2, keep_resets=0) == "ef"


def test_what_undoes_resets_comes_before_others_where_bytes_are_scarce() -> None:
    found = checkpoints("f", "e", "d", "c!", "b", "a!")
    assert left(found, keep_bytes=40) == "acef"
    assert left(found, keep_bytes=30) == "cef"


def test_what_a_restored_map_went_on_from_stays() -> None:
    found = checkpoints("f", "e", "d", "c!", "b", "a!")
    found[0] = dataclasses.replace(found[0], restored_as="b")
    assert left(found, keep=2) == "abcef"
    assert left(found, keep=2, keep_bytes=40) == "acef"
