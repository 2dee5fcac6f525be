"""Answers queries of where the sources of scans have been, and what they see."""

from triquad_format.errors import RefusedError
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.query_messages import SourcesReply, SourcesRequest

from triquad_server.intake.source_trails import SourceTrails

MOST_POINTS = 100_000
"""The points of the newest scans of all sources together, at most, in one reply."""


class SourceQueries:
    """Answers queries of what is new of the sources of scans."""

    def __init__(self, trails: SourceTrails, server: str) -> None:
        """Make the handler; ``server`` is the name that replies carry."""
        self._trails = trails
        self._server = server

    def sources(self, request: SourcesRequest) -> SourcesReply:
        """Return all sources, with what is new of them since the request's revision.

        Raises:
            RefusedError: a field is out of range.
        """
        if not 0 <= request.max_points <= MAX_SAMPLE_POINTS:
            raise RefusedError(
                "bad_request", f"max_points = {request.max_points}: use 0 to {MAX_SAMPLE_POINTS}"
            )
        # The revision of another run of the server is ignored.
        known = request.revision if request.server == self._server else 0
        revision, sources = self._trails.since(known, request.max_points, MOST_POINTS)
        if request.revision < 0 or known > revision:
            raise RefusedError(
                "bad_request",
                f"revision = {request.revision} is not one that this server gave: use that of the "
                "reply before, or 0",
            )
        return SourcesReply(self._server, revision, sources)
