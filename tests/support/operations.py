"""All operations of the wire protocol."""

from triquad_format.wire import keys

OPERATIONS = [
    value
    for name, value in vars(keys).items()
    if name.isupper() and isinstance(value, str) and value.startswith(("query/", "admin/"))
]
