"""Training a map to its end."""

from triquad_server.mapping.mapper import Mapper

from triquad_tools.console.progress import progress


def learn(mapper: Mapper) -> None:
    """Train a map until nothing is left to learn."""
    total = mapper.samples_left
    with progress("training", total) as report:
        while not mapper.settled:
            mapper.train()
            report(total - mapper.samples_left, f"{mapper.samples_trained / 1e6:.1f} M samples")
