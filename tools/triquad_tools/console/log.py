"""The log of a command that runs until it is stopped, on standard error."""

import logging

from triquad_format.printable import printable


def start_log(name: str) -> None:
    """Log messages, each line with the ``name`` of the part that logs it."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Lines(f"%(asctime)s %(levelname)s {name}: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class _Lines(logging.Formatter):
    """Lines in which names from the network cannot look like other lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the line of a message."""
        record.message = printable(record.message)
        return super().formatMessage(record)
