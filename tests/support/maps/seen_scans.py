"""Scans as evidence records them, without a server."""

from triquad_format.records.arrays import Doubles, Ints
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting


def end(evidence: LiveEvidence, ends: Doubles, sighting: Sighting) -> Ints:
    """Record rays that end at ``ends`` [N, 3], and the normals there; return their rows."""
    rows = evidence.record_ends(ends, sighting)
    search = evidence.outdated_normals(rows, sighting.unlearnt_since)
    search.find(0, len(search.rows))
    search.finish()
    return rows


def see(evidence: LiveEvidence, ends: Doubles, sighting: Sighting) -> Ints:
    """Record rays that end at ``ends`` [N, 3], and believe all of them; return their rows."""
    rows = end(evidence, ends, sighting)
    evidence.mark("surface", ends)
    return rows
