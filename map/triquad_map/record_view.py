"""The map in a record as something to ask, as fast as this installation can."""

from triquad_format.records.region import MapRecord

from triquad_map.reference.recorded_map import RecordedMap
from triquad_map.view import MapView


def record_view(record: MapRecord) -> MapView:
    """The map that a record holds: answered by compiled code where numba is installed, else numpy.

    This is the one door to compiled code for whoever must do without numba.
    """
    try:
        from triquad_map.compiled.recorded_view import recorded_view
    except ImportError:  # no numba, or one that does not go with this numpy
        return RecordedMap(record)
    return recorded_view(record)


def is_compiled(view: MapView) -> bool:
    """Whether compiled code answers, as in a server; numpy is far slower."""
    return not isinstance(view, RecordedMap)
