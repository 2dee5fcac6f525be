"""Settings of the section ``[service]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class ServiceSettings(BaseModel):
    """Limits of the network service."""

    model_config = SECTION

    scan_queue: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Scans of each source that wait; the oldest is pushed out, and counted. Sources take turns."""

    scan_queue_bytes: Annotated[int, Field(ge=1_000_000, le=2**40)] = 100_000_000
    """Bytes of the scans of all sources that wait; the oldest of the source that has most of them
    is pushed out."""

    request_queue: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Requests that wait, per group of operations; of more, the newest of the client that has most
    of them is refused."""

    request_queue_bytes: Annotated[int, Field(ge=0, le=2**40)] = 16_000_000
    """Bytes of the requests that wait, per group of operations, likewise."""

    request_timeout_max_s: Annotated[float, Field(ge=0.1, le=1e6)] = 60.0
    """A request is given up after this time, or after the shorter one for which its client
    waits."""

    query_workers: Annotated[int, Field(ge=1, le=64)] = 2
    """Threads that answer queries of the field, as many for distances and spheres, and as many for
    segments, rays, ground and grids."""

    max_query_points: Annotated[int, Field(ge=1, le=20_000_000)] = 1_000_000
    """Points of one request for the field."""

    max_search_points: Annotated[int, Field(ge=1, le=20_000_000)] = 250_000
    """Points of one request that searches around points."""

    publish_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.5
    """Time between epochs while the map changes."""

    epochs_kept: Annotated[int, Field(ge=1, le=1000)] = 4
    """Newest epochs that requests can ask for by number; a while after the last one was published,
    the newest alone."""

    epochs_pinned: Annotated[int, Field(ge=0, le=1000)] = 8
    """Older epochs that stay because they were asked for by number, of all clients together."""

    client_pins: Annotated[int, Field(ge=1, le=1000)] = 3
    """Epochs that one client may pin; of more, the one that it asked for longest ago goes."""

    pin_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0
    """Time for which an epoch stays after it was last asked for by number."""

    changes_kept: Annotated[int, Field(ge=0, le=100_000_000)] = 1_000_000
    """Voxels whose surface appeared or vanished that are remembered, each change of each, for
    clients that ask what changed: 13 bytes each."""

    flush_timeout_max_s: Annotated[float, Field(ge=0.1, le=1e6)] = 600.0
    """Longest time that a client may ask to wait in a flush."""
