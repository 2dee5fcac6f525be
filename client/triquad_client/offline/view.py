"""The map in a record as something to ask: compiled code where it is installed, else numpy.

The only place where the client meets compiled code.
"""

from collections.abc import Callable
from dataclasses import dataclass

from triquad_format.records.region import MapRecord
from triquad_map.reference.evaluator import MapEvaluator
from triquad_map.view import MapView


@dataclass(frozen=True)
class OpenView:
    """A map that can be asked until it is closed."""

    view: MapView
    compiled: bool  # whether compiled code answers, else numpy
    close: Callable[[], None]


def open_view(record: MapRecord) -> OpenView:
    """A map that answers what the record holds, as fast as this installation can."""
    try:
        from triquad_map.compiled.recorded_view import RecordedView
    except ImportError:  # no numba, or one that does not go with this numpy
        return OpenView(MapEvaluator(record), compiled=False, close=lambda: None)
    view = RecordedView(record)
    return OpenView(view, compiled=True, close=view.close)
