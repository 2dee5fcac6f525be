"""Limits of requests that clients check before they send, and servers before they answer."""

MAX_WAIT_S = 60.0
"""The longest time that a request may wait for its answer."""

MAX_SEQUENCE = 2**48 - 1
"""The largest number of a scan in its session."""

MIN_LENGTH_M = 1e-6
"""The least distance, range or grid cell: what is smaller is a mistake."""

MAX_POSITION_M = 1e9
"""The largest coordinate of a query: what is larger is hardly one in metres of the map frame."""

MAX_DISTANCE_M = 100.0
"""The largest distance of a search for surfaces; also the largest radius and grid cell."""

MAX_RANGE_M = 1_000.0
"""The longest range of a ray; also the longest segment."""

MAX_ITERATIONS = 50
"""The most steps of an alignment."""

MAX_QUERY_POINTS = 100_000
"""Points of one request for the field, which takes a server a tenth of a second of one core at
most; clients ask about more in several requests."""

MAX_SEARCHES = 20_000
"""Points of one request around which something is searched for, for as long. Cells of a grid and
points of a scan count as one each."""

RAY_M_PER_SEARCH = 2.0
"""Metres of a ray, or below a point on the way down to the ground, that count as one search: 2,000
m of rays take about as long as 1,000 distances."""

SEGMENT_M_PER_SEARCH = 0.25
"""Metres of a segment that count as one search: it is walked in shorter steps than a ray."""

MAX_KEYFRAMES = 50_000
"""Poses of one correction: 50 km with one each metre."""

LEVELS = 3
"""Levels of detail of meshes: cells of level ``l`` are ``2**l`` times as large as those of 0."""

MAX_SAMPLE_POINTS = 10_000
"""The most points of the newest scan of a source in a reply."""

TILE_INDEX_LIMIT = 1_000_000
"""Tile indices lie in ``[-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT]``."""

MAX_TILES_ASKED = 8
"""Mesh tiles of one request, each of which takes a server some tens of milliseconds of one core."""

MAX_CELL_M = 1e3
"""Side of the cells of a mesh: no server makes them nearly as large."""

MAX_TILE_M = 1e5
"""Side of a mesh tile."""

MAX_FILL_M = 5.0
"""The farthest that a mesh may be continued from seen surface."""

MAX_CHUNK_BYTES = 64 * 2**20
"""The most bytes of a map file in one reply."""

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


def payload_limit(points: int) -> int:
    """Return the most bytes of a message of ``points`` points: what is larger is not decoded."""
    return points * _POINT_BYTES + _OTHER_BYTES
