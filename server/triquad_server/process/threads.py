"""The teams of threads between which the server's work is split."""

from dataclasses import dataclass, field

from triquad_map.compiled.team import Team

NICENESS = 5
"""How much later than queries, for which somebody waits, the system schedules all other work."""


@dataclass(frozen=True)
class Teams:
    """Teams for the work of one map; their threads are started when they are first needed."""

    answers: Team = field(default_factory=lambda: Team("triquad-answers"))  # to queries
    # Taking in scans and training; the mapper's own thread has the same niceness.
    mapping: Team = field(default_factory=lambda: Team("triquad-mapping", NICENESS))
    # Tiles that nobody waits for at the moment.
    meshing: Team = field(default_factory=lambda: Team("triquad-meshing", NICENESS))

    def close(self) -> None:
        """End the threads; work that still comes is left to the callers."""
        for team in (self.answers, self.mapping, self.meshing):
            team.close()
