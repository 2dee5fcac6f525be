"""The errors of questions about a map."""


class TriquadError(Exception):
    """Base of all errors that a program which asks a map meets."""


class UnknownSpaceError(TriquadError):
    """What was asked about meets unknown space, which was to count as an error."""

    def __init__(self, what: str, index: int, count: int) -> None:
        others = f", and {count - 1} others do" if count > 1 else ""
        super().__init__(
            f"{what} {index} meets unknown space{others}: look there first, or let unknown space "
            "count as 'obstacle' or 'free'"
        )
        self.index = index
        self.count = count
