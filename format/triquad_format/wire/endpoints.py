"""Endpoints where a server listens and is found, as people write them and as Zenoh takes them."""

from typing import NamedTuple

from triquad_format.errors import FormatError

DEFAULT_PORT = 7447
DEFAULT_ENDPOINT = f"tcp/127.0.0.1:{DEFAULT_PORT}"

_FORMS = "use HOST, HOST:PORT or an endpoint of Zenoh such as tcp/robot:7447"
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")


class Locator(NamedTuple):
    """An endpoint of Zenoh without its metadata and configuration."""

    protocol: str
    host: str  # an address of IPv6 in brackets; of what has no port, empty
    port: str

    @classmethod
    def of(cls, endpoint: str) -> "Locator":
        """Return the parts of an endpoint, such as ``tcp/robot:7447``, whatever they are."""
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
        return cls(protocol, host, port)


def full_endpoint(text: str, protocol: str = "tcp") -> str:
    """Return the endpoint of Zenoh that ``text`` stands for.

    A host, such as ``robot``, ``192.168.0.7:7448`` or ``[::1]:7447``, is reached by ``protocol``,
    on port 7447 unless it names one. What has a ``/`` is an endpoint already and comes back as it
    is.

    Raises:
        FormatError: it is neither.
    """
    if not isinstance(text, str) or not text.strip() or text != text.strip():
        raise FormatError(f"endpoint {text!r}: {_FORMS}")
    if "/" in text:
        _check_port(text)
        return text
    host, port = _host_and_port(text)
    if not host or host.isdigit() or any(c.isspace() or c in "#?;" for c in host):
        raise FormatError(f"endpoint {text!r}: {host!r} is not a host; {_FORMS}")
    if not _is_port(port) or int(port) == 0:
        raise FormatError(f"endpoint {text!r}: {port!r} is not a port from 1 to 65535; {_FORMS}")
    return f"{protocol}/{host}:{port}"


def _check_port(endpoint: str) -> None:
    """Refuse an endpoint of Zenoh whose port is none; at port 0 the system chooses one.

    Raises:
        FormatError: it is.
    """
    protocol, _, port = Locator.of(endpoint)
    if protocol in _WITH_PORT and not _is_port(port):
        raise FormatError(f"endpoint {endpoint!r}: {port!r} is not a port up to 65535; {_FORMS}")


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and int(text) < 1 << 16


def is_of_this_machine(endpoint: str) -> bool:
    """Return whether only programs of this machine reach a Zenoh endpoint that is listened on."""
    protocol, host, _ = Locator.of(endpoint)
    if protocol.startswith("unix"):
        return True
    return host in ("localhost", "[::1]") or host.startswith("127.")


def _host_and_port(text: str) -> tuple[str, str]:
    """Return a host and its port; an address of IPv6 is in brackets then."""
    if text.startswith("["):
        host, _, rest = text.partition("]")
        return f"{host}]", rest.removeprefix(":") if rest else str(DEFAULT_PORT)
    if text.count(":") > 1:  # IPv6 without brackets has no room for a port
        return f"[{text}]", str(DEFAULT_PORT)
    host, colon, port = text.partition(":")
    return host, port if colon else str(DEFAULT_PORT)
