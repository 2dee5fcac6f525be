"""The sources of scans: the trail of each, and its newest scan."""

from triquad_format.errors import InvalidInputError
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.source_messages import SourceReport, SourcesRequest

from triquad_client import checks
from triquad_client.net.connection import Connection

_NOTHING = SourceReport(server="", revision=0, sources={})


class SourceCalls:
    """The call that tells where the sources of scans have been."""

    _connection: Connection

    def sources(self, since: SourceReport | None = None, max_points: int = 5_000) -> SourceReport:
        """Return where each source of scans has been, and its newest scan.

        To follow them, give the report before: it comes back where nothing is new.

        Args:
            since: the report before; ``None``: nothing is known yet.
            max_points: 0 to 10,000: as many points of each newest scan come, evenly drawn.

        Raises:
            NoReplyError: the server may be of a release that does not know this question.
        """
        if since is not None and not isinstance(since, SourceReport):
            raise InvalidInputError(f"since = {since!r}: give what an earlier call returned")
        limit = checks.count("max_points", max_points, MAX_SAMPLE_POINTS)
        known = since or _NOTHING
        reply = self._connection.ask(SourcesRequest(known.server, known.revision, limit))
        is_same = (reply.server, reply.revision) == (known.server, known.revision)
        return known if is_same else reply
