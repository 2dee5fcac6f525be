"""The map in a record as something to ask, as fast as this installation can."""

from collections.abc import Callable
from dataclasses import dataclass

from triquad_format.records.region import MapRecord

from triquad_map.reference.evaluator import MapEvaluator
from triquad_map.view import MapView


@dataclass(frozen=True)
class OpenView:
    """A map that can be asked until it is closed."""

    view: MapView
    compiled: bool  # whether compiled code answers, as in a server; numpy is far slower
    close: Callable[[], None]


def open_view(record: MapRecord) -> OpenView:
    """The map that a record holds: answered by compiled code where numba is installed, else numpy.

    This is the one door to compiled code for whoever must do without numba.
    """
    try:
        from triquad_map.compiled.recorded_view import RecordedView
    except ImportError:  # no numba, or one that does not go with this numpy
        return OpenView(MapEvaluator(record), compiled=False, close=lambda: None)
    view = RecordedView(record)
    return OpenView(view, compiled=True, close=view.close)
