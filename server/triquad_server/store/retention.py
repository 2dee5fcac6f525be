"""Chooses the checkpoints that stay, without access to files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from triquad_server.settings import StoreSettings

_MIN_KEPT = 2
"""The number of newest checkpoints that always stay: should one be damaged, there is another."""


@dataclass(frozen=True)
class StoredCheckpoint:
    """The properties of a checkpoint that decide whether it stays."""

    files: Mapping[str, int]  # bytes of each of its parts and of its own file, by name
    undoes: str = ""  # what going back to it undoes, such as a reset; empty: nothing
    restored_as: str = ""  # file of the checkpoint that a restored map went on from; empty: none


def staying(
    checkpoints: Sequence[StoredCheckpoint], settings: StoreSettings
) -> list[StoredCheckpoint]:
    """Return those of all checkpoints, the newest first, that stay.

    These are the two newest and, as long as ``keep_bytes`` suffice, first the newest
    ``keep_resets`` before them that undo something, then the one that the map was last restored as,
    then the newest ``keep`` of all.
    """
    undoing = [one for one in checkpoints[_MIN_KEPT:] if one.undoes][: settings.keep_resets]
    restored = [one for one in checkpoints if checkpoints[0].restored_as in one.files]
    files: dict[str, int] = {}
    stay: list[StoredCheckpoint] = []
    candidates = [*checkpoints[:_MIN_KEPT], *undoing, *restored, *checkpoints[: settings.keep]]
    for number, one in enumerate(candidates):
        files |= one.files
        if number >= _MIN_KEPT and 0 < settings.keep_bytes < sum(files.values()):
            break
        stay.append(one)
    return stay


def files_of(checkpoints: Iterable[StoredCheckpoint]) -> dict[str, int]:
    """Return the bytes of all files that checkpoints need; what they share is there once."""
    files: dict[str, int] = {}
    for checkpoint in checkpoints:
        files |= checkpoint.files
    return files
