"""The map in a record as something to ask: compiled code where it is installed, else numpy.

The only place where the client meets compiled code.
"""

from triquad_format.records.region import MapRecord
from triquad_map.reference.recorded_map import RecordedMap
from triquad_map.view import MapView


def view_of(record: MapRecord) -> MapView:
    """A map that answers what the record holds, as fast as this installation can."""
    try:
        from triquad_map.compiled.recorded_view import recorded_view
    except ImportError:  # no numba, or one that does not go with this numpy
        return RecordedMap(record)
    return recorded_view(record)


def is_compiled(view: MapView) -> bool:
    """Whether compiled code answers."""
    return not isinstance(view, RecordedMap)
