"""Why no scan can be made of what a sensor said. Each text says what to do about it."""

from triquad_format.errors import TriquadError


class NoScanError(TriquadError):
    """No scan can be made of what a sensor said; ``reason`` is the short key to count it under."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class NoTransformError(NoScanError):
    """Where a sensor was is not known: ``late`` where transforms that still come may tell."""

    def __init__(self, reason: str, text: str, *, late: bool = False) -> None:
        super().__init__(reason, text)
        self.late = late
