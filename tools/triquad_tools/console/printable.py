"""Text of others, such as names that came over the network, made safe for a terminal."""


def printable(text: str) -> str:
    r"""``text`` with what would steer a terminal, or be invisible on it, as escapes: ``\x1b``."""
    return "".join(c if c.isprintable() else _escape(c) for c in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
