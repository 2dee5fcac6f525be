"""The attachment of a request: who asks, and for how long."""

import functools
from dataclasses import dataclass

from triquad_format.errors import WireError
from triquad_format.wire import codec
from triquad_format.wire.codec import Message

MAX_ORIGIN_BYTES = 1024
"""A longer attachment is not read."""

_REMEMBERED = 256


@dataclass(frozen=True)
class RequestOrigin(Message):
    """Attached to a request, so that clients are answered in turn and nobody works for nothing."""

    client: str  # Zenoh id of the session that asks, hexadecimal
    timeout_s: float  # nobody waits for the reply for longer


def read_origin(attachment: bytes) -> RequestOrigin | None:
    """Return the origin that an attachment names; ``None`` where it names none."""
    return None if len(attachment) > MAX_ORIGIN_BYTES else _decoded(attachment)


@functools.lru_cache(_REMEMBERED)  # a client attaches the same to all that it asks
def _decoded(attachment: bytes) -> RequestOrigin | None:
    try:
        return codec.decode(RequestOrigin, attachment)
    except WireError:
        return None
