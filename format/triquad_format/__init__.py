"""Every byte that leaves a triquad process: wire messages, the map file, and its evaluator.

This package needs numpy, msgpack and mcap only; it imports neither the server nor the client.
"""

__version__ = "0.1.0"
