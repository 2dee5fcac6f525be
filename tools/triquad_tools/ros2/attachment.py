"""The attachments of rmw_zenoh to messages, whose numbers show how many never arrived."""

import struct

ATTACHMENT = struct.Struct("<qqB16s")
"""The attachment: number, time, length of the identity, identity of the publisher."""

_MAX_PUBLISHERS = 256
_MAX_MISSED = 2**20  # a larger step is of a publisher that was started again, or of wrong bytes


class SequenceGaps:
    """The last number of each publisher."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}

    def missed(self, attachment: bytes) -> int:
        """Return how many messages of its publisher are missing before one with this attachment.

        An attachment in another form, as by old releases, is ignored, and so is a
        number below 0 or one that is too far ahead.
        """
        if len(attachment) != ATTACHMENT.size:
            return 0
        number: int
        number, _, _, publisher = ATTACHMENT.unpack(attachment)
        if len(self._last) > _MAX_PUBLISHERS:
            self._last.clear()
        last = self._last.get(publisher, number - 1)
        self._last[publisher] = number
        missed = number - last - 1
        return missed if 0 <= missed <= _MAX_MISSED and last >= 0 else 0
