"""The client of triquad map servers.

import triquad_client as triquad

with triquad.connect("tcp/127.0.0.1:7447") as client:
    client.publish_scan(points, world_from_sensor)
    client.flush()
    result = client.query_sdf(points_to_check)
"""

from triquad_format import __version__
from triquad_format.errors import InvalidInputError, MapFileError, RefusedError, TriquadError
from triquad_format.records.status import Status, Statuses
from triquad_format.wire.messages import CheckpointInfo, MapInfo, ResetReply
from triquad_format.wire.metrics_messages import (
    CheckpointMetrics,
    OperationMetrics,
    QueueMetrics,
    ServerMetrics,
    SourceMetrics,
    TimeHistogram,
)
from triquad_format.wire.source_messages import (
    CorrectPosesReply,
    NewestScan,
    ScanSource,
    SourceReport,
)
from triquad_format.wire.status_messages import FieldFit, KeptScans, ServerStatus
from triquad_map.questions.align import Alignment
from triquad_map.questions.bodies import Polyline, Segments, Spheres
from triquad_map.questions.distance import Distances, Unknown, UnknownSpaceError
from triquad_map.questions.grid import Grid
from triquad_map.questions.ground import Ground
from triquad_map.questions.rays import RayRanges
from triquad_map.view import NotAskedError

from triquad_client.async_client import (
    AsyncClient,
    AsyncMeshWatch,
    AsyncPinnedMap,
    AsyncSyncedMap,
    connect_async,
)
from triquad_client.calls.changes import ChangedBox, ChangeKind, ChangeReport
from triquad_client.calls.point_queries import SdfResult
from triquad_client.calls.queries import MapQueries, PinnedMap
from triquad_client.calls.scans import FlushReport
from triquad_client.checks import Bounds
from triquad_client.client import Client, connect
from triquad_client.depth_image import Intrinsics, depth_points, empty_returns
from triquad_client.errors import (
    BadReplyError,
    ClosedError,
    ConnectError,
    DownloadError,
    EmptierMapError,
    InvalidScanError,
    NoReplyError,
    RequestTimeoutError,
    UnknownMapError,
)
from triquad_client.mesh.followed_mesh import KnownTiles, MeshTile, MeshUpdate
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_client.offline.offline_map import OfflineMap, open_map
from triquad_client.offline.synced_map import SyncedMap, SyncReport
from triquad_client.pose import Pose, PoseLike

__all__ = [
    "Alignment",
    "AsyncClient",
    "AsyncMeshWatch",
    "AsyncPinnedMap",
    "AsyncSyncedMap",
    "BadReplyError",
    "Bounds",
    "ChangeKind",
    "ChangeReport",
    "ChangedBox",
    "CheckpointInfo",
    "CheckpointMetrics",
    "Client",
    "ClosedError",
    "ConnectError",
    "CorrectPosesReply",
    "Distances",
    "DownloadError",
    "EmptierMapError",
    "FlushReport",
    "Grid",
    "Ground",
    "KnownTiles",
    "InvalidInputError",
    "InvalidScanError",
    "Intrinsics",
    "MapFileError",
    "MapInfo",
    "MapQueries",
    "Mesh",
    "MeshTile",
    "MeshUpdate",
    "MeshWatch",
    "NewestScan",
    "NoReplyError",
    "NotAskedError",
    "OfflineMap",
    "OperationMetrics",
    "PinnedMap",
    "Polyline",
    "Pose",
    "PoseLike",
    "QueueMetrics",
    "RayRanges",
    "RefusedError",
    "RequestTimeoutError",
    "ResetReply",
    "ScanSource",
    "SdfResult",
    "Segments",
    "ServerMetrics",
    "FieldFit",
    "KeptScans",
    "ServerStatus",
    "SourceMetrics",
    "SourceReport",
    "Spheres",
    "Status",
    "Statuses",
    "SyncReport",
    "SyncedMap",
    "TimeHistogram",
    "TriquadError",
    "Unknown",
    "UnknownMapError",
    "UnknownSpaceError",
    "__version__",
    "connect",
    "connect_async",
    "depth_points",
    "empty_returns",
    "open_map",
]


def __dir__() -> list[str]:
    """Return what is public."""
    return __all__
