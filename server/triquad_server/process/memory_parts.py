"""What takes the memory of a server."""

from collections.abc import Callable


class MemoryParts:
    """Tells how many bytes each part of a server takes, besides the map itself."""

    def __init__(self, program: int = 0) -> None:
        """Begin with the ``program`` alone: its code, its libraries, and what is compiled."""
        self._parts: dict[str, Callable[[], int]] = {"program": lambda: program}

    def add(self, name: str, count: Callable[[], int]) -> None:
        """Count another part from now on."""
        self._parts[name] = count

    def bytes(self) -> dict[str, int]:
        """Return the bytes of each part by its name."""
        return {name: count() for name, count in self._parts.items()}

    def total(self) -> int:
        """Return the bytes of all parts together."""
        return sum(self.bytes().values())
