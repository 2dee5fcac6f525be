"""Settings of the section ``[change]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class ChangeSettings(BaseModel):
    """How quickly a surface is taken back that rays pass through, in a world that changes."""

    model_config = SECTION

    static: bool = False
    """The world stands still: no surface is ever taken back."""

    scans: Annotated[int, Field(ge=1, le=1000)] = 3
    """Scans in a row, at least, of which rays pass where a surface was, and none ends there."""

    doubt: Annotated[float, Field(ge=1e-9, le=0.5)] = 0.01
    """How probable such rays may be, at most, if the surface were still there: told by how often
    rays ended and passed there before."""
