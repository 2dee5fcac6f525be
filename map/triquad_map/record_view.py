"""The map in a record as something to ask, as fast as this installation can."""

import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass

from triquad_format.records.region import MapRecord

from triquad_map.composition.composed_view import ComposedView
from triquad_map.reference.evaluator import MapEvaluator

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OpenView:
    """A map that can be asked until it is closed."""

    view: ComposedView
    compiled: bool  # whether compiled code answers, as in a server; numpy is far slower
    close: Callable[[], None]


def open_view(record: MapRecord) -> OpenView:
    """Return the map of a record: answered by compiled code where numba is installed, else numpy.

    This is the one door to compiled code for those who must do without numba.
    """
    try:
        from triquad_map.compiled.recorded_view import RecordedView
    except ImportError as error:  # no numba, or one that does not go with this numpy
        _tell_what_to_install(str(error))
        return OpenView(MapEvaluator(record), compiled=False, close=lambda: None)
    view = RecordedView(record)
    return OpenView(view, compiled=True, close=view.close)


@functools.cache  # once
def _tell_what_to_install(reason: str) -> None:
    _log.warning(
        "no compiled code (%s): numpy answers some forty times as slowly, the first distance after "
        "ten seconds for 100 m of street; pip install 'triquad[fast]'",
        reason,
    )
