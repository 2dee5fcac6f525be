"""Errors in data of sensors. Each text says what to do about it."""

from triquad_format.errors import TriquadError


class NoScanError(TriquadError):
    """No scan can be made of a sensor's data; ``reason`` is the short key to count it under."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class NoTransformError(NoScanError):
    """The pose of a sensor is not known; ``late`` if transforms that still come may give it."""

    def __init__(self, reason: str, text: str, *, late: bool = False) -> None:
        super().__init__(reason, text)
        self.late = late
