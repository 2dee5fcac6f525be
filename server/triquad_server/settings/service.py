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
    """Requests of each client that wait, and an eighth of those of all; of more, the newest of the
    client that has most of them is refused."""

    publish_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.5
    """Time between epochs while the map changes."""

    epochs_kept: Annotated[int, Field(ge=1, le=1000)] = 4
    """Newest epochs that requests can ask for by number; a while after the last one was published,
    the newest alone."""

    epochs_pinned: Annotated[int, Field(ge=0, le=1000)] = 8
    """Older epochs that stay because they were asked for by number; of more, the one that was asked
    for longest ago is removed."""

    pin_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0
    """Time for which an epoch stays after it was last asked for by number."""
