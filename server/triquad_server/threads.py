"""The teams of threads between which the server's work is split."""

from triquad_map.compiled.team import Team

ANSWERS = Team("triquad-answers")
"""For queries: someone waits."""

PATIENCE = 5
"""Of everything but queries."""

MAPPING = Team("triquad-mapping", PATIENCE)
"""For taking in scans and training; the mapper's own thread is as patient."""
