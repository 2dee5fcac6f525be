"""Places where things come and go, and a robot at rest."""

import argparse
from collections.abc import Iterator

from bench.figures import Figure
from bench.parts.belief import follow
from bench.parts.parked import measure_parked
from bench.scenes.episodes import Episode
from bench.scenes.known_episodes import held_episodes, tuned_episodes

_EMPTY_SCANS = 110  # of each place, once the things have left


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of the episodes to tune on, of those to score on only, and of a robot."""
    episodes = [*tuned_episodes(_EMPTY_SCANS), *held_episodes(_EMPTY_SCANS)]
    figures = [figure for episode in episodes for figure in _figures(episode)]
    return figures + measure_parked(options.seed)


def _figures(episode: Episode) -> Iterator[Figure]:
    seen = follow(episode)
    for name, left in seen.left.items():
        for passes, (surface, count) in sorted(left.items()):
            title = f"{episode.name}: {name}, SURFACE after {passes} scans that pass ({count})"
            yield Figure(title, 100 * surface / max(count, 1), "%")
    for scans, blocked_m in seen.blocked_m.items():
        yield Figure(f"{episode.name}: lane blocked after {scans}", blocked_m, "m")
    for what, share in seen.kept.items():
        yield Figure(f"{episode.name}: {what} lost", 100 * (1 - share), "%")
