"""Text of others, such as names that came over the network, made safe for a terminal."""

_CUT = "..."


def printable(text: str, most: int | None = None) -> str:
    r"""Return ``text`` with what steers a terminal, or is invisible on it, as escapes: ``\x1b``.

    So are line breaks, what turns the direction of writing around, and halves of surrogate pairs.
    Of more than ``most`` characters, those at the end are left out.
    """
    if not text.isprintable():
        text = "".join(c if c.isprintable() else _escape(c) for c in text)
    if most is not None and len(text) > most:
        return text[: most - len(_CUT)] + _CUT
    return text


def printable_lines(text: str) -> str:
    """Return ``text`` as :func:`printable`, but for its line breaks."""
    return "\n".join(map(printable, text.split("\n")))


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
