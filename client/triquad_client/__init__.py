"""The client of triquad map servers.

import triquad_client as triquad

with triquad.connect("tcp/127.0.0.1:7447") as client:
    client.publish_scan(points, world_from_sensor)
    client.flush()
    result = client.query_sdf(points_to_check)
"""

from triquad_format import __version__
from triquad_format.messages import CheckpointInfo, MapInfo, ServerStatus, TileList
from triquad_format.status import Status

from triquad_client.checks import Bounds
from triquad_client.client import Client, connect
from triquad_client.errors import (
    BadReplyError,
    ClosedError,
    ConnectError,
    DownloadError,
    InvalidInputError,
    InvalidScanError,
    NoReplyError,
    RefusedError,
    RequestTimeoutError,
    TriquadError,
    UnknownMapError,
)
from triquad_client.mesh import Mesh
from triquad_client.mesh_tiles import HeldTiles, MeshTile
from triquad_client.mesh_watch import MeshUpdate, MeshWatch
from triquad_client.scans import FlushReport
from triquad_client.sdf import SdfResult

__all__ = [
    "BadReplyError",
    "Bounds",
    "CheckpointInfo",
    "Client",
    "ClosedError",
    "ConnectError",
    "DownloadError",
    "FlushReport",
    "HeldTiles",
    "InvalidInputError",
    "InvalidScanError",
    "MapInfo",
    "Mesh",
    "MeshTile",
    "MeshUpdate",
    "MeshWatch",
    "NoReplyError",
    "RefusedError",
    "RequestTimeoutError",
    "SdfResult",
    "ServerStatus",
    "Status",
    "TileList",
    "TriquadError",
    "UnknownMapError",
    "__version__",
    "connect",
]
