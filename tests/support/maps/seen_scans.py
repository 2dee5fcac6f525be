"""Scans as evidence records them, without a server."""

from triquad_format.records.arrays import Doubles, Ints
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting


def see(evidence: LiveEvidence, ends: Doubles, sighting: Sighting) -> Ints:
    """Record rays that end at ``ends`` [N, 3], and believe all of them; return their rows."""
    rows = evidence.record_ends(ends, sighting)
    evidence.mark_surface(ends)
    return rows
