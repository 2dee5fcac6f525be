"""Every byte that leaves a triquad process: wire messages and the map file.

This package needs numpy, msgpack and mcap only; it imports neither the server nor the client.
"""

__version__ = "0.2.0"
