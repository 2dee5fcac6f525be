"""Settings of the section ``[memory]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class MemorySettings(BaseModel):
    """How much memory the map may take."""

    model_config = SECTION

    max_bytes: Annotated[int, Field(ge=1_000_000, le=2**50)] = 2_000_000_000
    """Of the live map with its newest epoch. A scan that would make it larger is refused as
    `map_full`; one that shows nothing new is taken on, and all else goes on too."""

    epochs_bytes: Annotated[int, Field(ge=0, le=2**50)] = 300_000_000
    """Of older epochs that can be asked for by number, beyond what they share with newer ones;
    those that were asked for last stay first."""
