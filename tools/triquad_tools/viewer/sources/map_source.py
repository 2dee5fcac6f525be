"""What a page shows: the map of a server that learns, or of a file."""

from triquad_client.mesh.mesh_watch import MeshWatch

from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.stored_map import StoredMap, StoredTiles

MapSource = LiveSource | StoredMap
"""A map to show: each has a title, queries, the sizes of its mesh, and tiles to follow."""

TileFollower = MeshWatch | StoredTiles
"""The mesh tiles of a level within a box, which ``next`` brings up to date bit by bit."""
