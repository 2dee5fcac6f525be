"""Settings of the section ``[store]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class StoreSettings(BaseModel):
    """When checkpoints are written and how far back they are kept."""

    model_config = SECTION

    period_s: Annotated[float, Field(ge=0, le=1e7)] = 60.0
    """Time between checkpoints while the map changes; 0: only on request."""

    keep: Annotated[int, Field(ge=2, le=1_000_000)] = 20
    """Newest checkpoints that stay on disk; two always do."""

    keep_resets: Annotated[int, Field(ge=0, le=1000)] = 10
    """Of so many resets the map just before stays as well; 0: a reset keeps nothing."""

    keep_bytes: Annotated[int, Field(ge=0, le=2**60)] = 4_000_000_000
    """The oldest checkpoints are deleted while all take more, but for two; 0: no limit."""

    scrub_h: Annotated[float, Field(ge=0, le=1e6)] = 24.0
    """Hours between checks of all checkpoints on disk, which find what rots there; 0: none."""
