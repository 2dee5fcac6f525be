"""Why a server process stops; quick to import, so that signals are heeded from the start."""

import queue
from enum import Enum


class Stop(Enum):
    """Why a server stops."""

    ASKED = "asked to"
    DEFECT = "by a defect"


Stops = queue.SimpleQueue[Stop]
"""Where signals and defects ask the server to stop; may be put to from a signal handler."""
