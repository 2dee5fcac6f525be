"""The thread on which an output of the map is published."""

import logging
import threading
from collections.abc import Callable

from triquad_format.errors import TriquadError

from triquad_tools.ros2.intake.scan_publisher import Place

_log = logging.getLogger("triquad_ros2")

PERIOD_S = 0.5  # between two rounds
_RETRY_S = 5.0  # after an error


class MapThread:
    """Has an output published again and again, until it is closed; it holds up no other."""

    def __init__(self, publish: Callable[[Place], None], place: Callable[[], Place | None]) -> None:
        """``place`` returns where the robot is, None before that is known.

        ``publish`` publishes what changed for a robot there, and returns soon, also if there is
        more; it raises a TriquadError where the map server does not answer.
        """
        self._publish = publish
        self._place = place
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-map")
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        pause_s = PERIOD_S
        while not self._stopping.wait(pause_s):
            place, pause_s = self._place(), PERIOD_S
            if place is None:
                continue
            try:
                self._publish(place)
            except TriquadError as error:
                _log.warning("the map cannot be published now: %s", error)
                pause_s = _RETRY_S
            except Exception:
                _log.exception("the map could not be published")
                pause_s = _RETRY_S
