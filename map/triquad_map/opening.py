"""The map in a record as something to ask, for those who may be without numba."""

from typing import TYPE_CHECKING

from triquad_format.errors import NoCompiledCodeError
from triquad_format.records.region import MapRecord

if TYPE_CHECKING:
    from triquad_map.composition.composed_view import RecordedView


def open_view(record: MapRecord) -> "RecordedView":
    """Return the map of a record, to be asked until it is closed.

    Raises:
        NoCompiledCodeError: there is no numba, or one that does not go with this numpy.
    """
    try:
        from triquad_map.composition.composed_view import RecordedView
    except ImportError as error:
        raise NoCompiledCodeError(
            "maps are asked by compiled code, and numba is missing: pip install 'triquad[fast]'"
        ) from error
    return RecordedView(record)
