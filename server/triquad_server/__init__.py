"""The triquad map server.

``triquad-server`` is a process of its own; a script or a notebook may run a server within itself:

import triquad_server

with triquad_server.serve() as server, server.client() as client:
    client.publish_scan(points, world_from_sensor)
"""

from triquad_server.embedded import Server, serve

__all__ = ["Server", "serve"]
