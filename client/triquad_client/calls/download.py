"""Fetching the map as a file; its chunks go in the background of everything else."""

import hashlib
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError
from triquad_format.mapfile.files import replacing
from triquad_format.mapfile.writer import MapFileInfo, write_map
from triquad_format.records.crop import crop_record
from triquad_format.wire import keys
from triquad_format.wire.messages import MapInfo, MapInfoRequest
from triquad_map.stored_map import StoredMap

from triquad_client import checks
from triquad_client.calls.remote_bytes import RemoteBytes
from triquad_client.checks import Bounds
from triquad_client.errors import DownloadError
from triquad_client.net.call import Ask, Call, Run, ask, offload, retried

_PREPARE_S = 120.0
"""The server writes the file before it answers."""

_BLOCK_BYTES = 2**23


def fetch(path: Path, training: bool) -> Call[MapInfo]:
    """Write the newest map to ``path``, all of it or nothing.

    Raises:
        DownloadError: the bytes are not those the server announced.
    """
    # Newer map files may push this one out of the server: then the newest is taken.
    return retried("chunk_gone", lambda: offload(lambda run: _fetch(run, path, training)))


def fetch_box(path: Path, bounds: Bounds) -> Call[MapFileInfo]:
    """Write what answers in the bounds; only its parts travel.

    Raises:
        DownloadError: nothing of the map lies in the box, or its parts are not valid.
    """
    minimum, maximum = checks.finite_box(bounds)
    job = partial(_fetch_box, path=path, minimum=minimum, maximum=maximum)
    return (yield from retried("chunk_gone", lambda: offload(job)))


def _fetch(run: Run, path: Path, training: bool) -> MapInfo:
    info = run(newest_file(training))
    with replacing(path) as file:
        _copy(RemoteBytes(run, info), file, info.sha256)
    return info


def _fetch_box(
    run: Run, path: Path, minimum: NDArray[np.float64], maximum: NDArray[np.float64]
) -> MapFileInfo:
    try:
        stored = StoredMap(RemoteBytes(run, run(newest_file(training=False))))
        record = crop_record(stored.box(minimum, maximum), minimum, maximum)
        if not record.has_evidence:
            raise DownloadError(
                f"nothing of the map lies between {minimum.tolist()} and {maximum.tolist()}"
            )
        return write_map(record, path, stamp_ns=stored.manifest.stamp_ns or None)
    except FormatError as error:
        raise DownloadError(str(error)) from error


def newest_file(training: bool) -> Call[MapInfo]:
    """The file of the newest epoch, which the server keeps for a while."""
    request = MapInfoRequest(training)
    return ask(Ask(keys.MAP_INFO, request, MapInfo, background=True, min_timeout_s=_PREPARE_S))


def _copy(remote: RemoteBytes, file: BinaryIO, sha256: str) -> None:
    digest = hashlib.sha256()
    for offset in range(0, remote.size, _BLOCK_BYTES):
        data = remote.read(offset, min(_BLOCK_BYTES, remote.size - offset))
        digest.update(data)
        file.write(data)
    if digest.hexdigest() != sha256:
        raise DownloadError(f"the file's SHA-256 is {digest.hexdigest()}, not {sha256}")
