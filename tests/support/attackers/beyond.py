"""What comes from beyond this machine, as far as a server can tell."""

import socket

import pytest


def address_beyond() -> str:
    """An address of this machine that is not the loopback's; the test is skipped without one.

    What connects to it shows at the network's interface, as from another machine.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing, but asks which way it would go
        except OSError as error:
            pytest.skip(f"this machine has the loopback alone: {error}")
        address = probe.getsockname()[0]
    if address.startswith("127."):
        pytest.skip("this machine has the loopback alone")
    return str(address)


def from_beyond(endpoint: str) -> str:
    """An endpoint on all interfaces, such as ``tcp/0.0.0.0:7447``, as others reach it."""
    return f"tcp/{address_beyond()}:{endpoint.rpartition(':')[2]}"
