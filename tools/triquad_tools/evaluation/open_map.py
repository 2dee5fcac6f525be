"""A map to ask, whether it is a file or a server has it."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError

from triquad_tools.console.errors import ToolError
from triquad_tools.evaluation.map_scores import MapQuery
from triquad_tools.evaluation.meshfile import Mesh

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream)/")

MeshOf = Callable[[NDArray[np.float64]], Mesh]
"""Gives the mesh within bounds ``[2, 3]``."""


class MapUnreachableError(ToolError):
    """A server that does not have the map, or does not answer."""


@dataclass(frozen=True)
class OpenMap:
    """A map that answers."""

    query: MapQuery
    mesh: MeshOf | None  # None: a file, which has no mesh


@contextmanager
def open_map(target: str, map_name: str) -> Iterator[OpenMap]:
    """The map in the file ``target``, or on the server at the Zenoh endpoint ``target``.

    Raises:
        ToolError: the file cannot be read.
        MapUnreachableError: no server there has the map, or it stopped answering.
    """
    if not _ENDPOINT.match(target):
        yield _open_file(Path(target))
        return
    from triquad_client import Client, TriquadError, connect

    def mesh_of(client: Client, bounds: NDArray[np.float64]) -> Mesh:
        found = client.mesh((bounds[0].tolist(), bounds[1].tolist()))
        return Mesh(found.vertices, found.faces)

    try:
        with connect(target, map_name) as client:
            yield OpenMap(client.query_sdf, lambda bounds: mesh_of(client, bounds))
    except TriquadError as error:
        raise MapUnreachableError(str(error)) from error


def _open_file(path: Path) -> OpenMap:
    from triquad_format.mapfile.reader import read_map
    from triquad_map.reference.evaluator import MapEvaluator

    try:
        return OpenMap(MapEvaluator(read_map(path)).query, None)
    except (FormatError, OSError) as error:
        raise ToolError(str(error)) from error
