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
from triquad_query.align import Alignment
from triquad_query.distance import Distances
from triquad_query.errors import TriquadError, UnknownSpaceError
from triquad_query.grid import Grid
from triquad_query.polyline import Polyline
from triquad_query.rays import Rays
from triquad_query.segments import Segments
from triquad_query.spheres import Spheres
from triquad_query.unknown import Unknown

from triquad_client.async_client import AsyncClient, connect_async
from triquad_client.async_queries import AsyncPinnedMap
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
    UnknownMapError,
)
from triquad_client.followed_mesh import MeshUpdate
from triquad_client.local_copy import SyncReport
from triquad_client.mesh import Mesh
from triquad_client.mesh_tiles import HeldTiles, MeshTile
from triquad_client.mesh_watch import AsyncMeshWatch, MeshWatch
from triquad_client.offline import OfflineMap, open_map
from triquad_client.queries import MapQueries, PinnedMap
from triquad_client.questions.sdf import SdfResult
from triquad_client.scans import FlushReport
from triquad_client.synced import AsyncSyncedMap, SyncedMap

__all__ = [
    "Alignment",
    "AsyncClient",
    "AsyncMeshWatch",
    "AsyncPinnedMap",
    "AsyncSyncedMap",
    "BadReplyError",
    "Bounds",
    "CheckpointInfo",
    "Client",
    "ClosedError",
    "ConnectError",
    "Distances",
    "DownloadError",
    "FlushReport",
    "Grid",
    "HeldTiles",
    "InvalidInputError",
    "InvalidScanError",
    "MapInfo",
    "MapQueries",
    "Mesh",
    "MeshTile",
    "MeshUpdate",
    "MeshWatch",
    "NoReplyError",
    "OfflineMap",
    "PinnedMap",
    "Polyline",
    "Rays",
    "RefusedError",
    "RequestTimeoutError",
    "SdfResult",
    "Segments",
    "ServerStatus",
    "Spheres",
    "Status",
    "SyncReport",
    "SyncedMap",
    "TileList",
    "TriquadError",
    "Unknown",
    "UnknownMapError",
    "UnknownSpaceError",
    "__version__",
    "connect",
    "connect_async",
    "open_map",
]
