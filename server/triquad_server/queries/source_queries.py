"""Answers queries of where the sources of scans have been, and what they see."""

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
        """Return all sources, if anything of them is new since the reply before."""
        revision = self._trails.revision  # first: what comes meanwhile is new the next time
        if (request.server, request.revision) == (self._server, revision):
            return SourcesReply(self._server, revision, None)
        sources = self._trails.states(request.max_points, MOST_POINTS)
        return SourcesReply(self._server, revision, sources)
