"""When each place of a map last changed, as the manifest of its file tells."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.parts.part import CELL_LEAVES, EVIDENCE, VERTICES, PartKey, extent
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import region_centre, region_corner

from triquad_tools.console.report import utc_time
from triquad_tools.mapfiles.seen_space import Columns
from triquad_tools.plots.plan import Layer, Plan, PlanGrid, Window, draw_layers

_NEVER = -1
_MOST_COLOURS = 6
_PLAN_PLANE = 0  # XY


@dataclass(frozen=True)
class _Age:
    """Epochs that share a colour."""

    first: int
    last: int
    stamp_ns: int  # of the last; 0 if not known

    def __str__(self) -> str:
        epochs = f"epoch {self.last}"
        if self.first != self.last:
            epochs = f"epochs {self.first} to {self.last}"
        return ", ".join(filter(None, (epochs, utc_time(self.stamp_ns))))


def ages_plan(grid: PlanGrid, manifest: Manifest, seen: Columns) -> Plan:
    """A plan of the epochs in which places last changed, square by square."""
    epochs = np.where(grid.marked(seen.middles), latest_epochs(grid, manifest), _NEVER)
    ages = _ages(epochs, manifest)
    colours = colormaps["viridis"](np.linspace(0.0, 1.0, len(ages)))[::-1]  # the latest is dark
    layers = [
        Layer(str(age), to_hex(colour), (epochs >= age.first) & (epochs <= age.last))
        for age, colour in zip(ages, colours, strict=True)
    ]
    side_m = manifest.facts.settings.leaf_m * CELL_LEAVES
    note = f"told apart in squares of {side_m:g} m"
    return Plan("Last changed", lambda axes: draw_layers(axes, layers[::-1]), note)


def latest_epochs(grid: PlanGrid, manifest: Manifest) -> NDArray[np.int64]:
    """``[rows, columns]``: the epoch in which a place last changed; -1 where there is none."""
    latest = np.full((grid.rows, grid.columns), _NEVER, np.int64)
    for entry in manifest.entries:
        window = _window(grid, manifest.facts.settings, entry.key)
        if window is not None:
            latest[window] = np.maximum(latest[window], entry.epoch)
    return latest


def _window(grid: PlanGrid, settings: FieldSettings, key: PartKey) -> Window | None:
    """What a part covers in the plan, as far as answers of its region hang on it."""
    if key.topic != EVIDENCE and (key.topic, key.plane) != (VERTICES, _PLAN_PLANE):
        return None
    box = extent(settings, key)
    corner = region_corner(settings, key.region)[:2]
    low, high = (corner + settings.leaf_m * end[:2] for end in (box.low, box.high))
    centre = region_centre(settings, key.region)[:2]
    half = settings.region_pitch_m / 2
    return grid.window(np.maximum(low, centre - half), np.minimum(high, centre + half))


def _ages(epochs: NDArray[np.int64], manifest: Manifest) -> list[_Age]:
    """The epochs in a plan, oldest first, so few that colours can tell them apart."""
    stamps = {entry.epoch: entry.stamp_ns for entry in manifest.entries}
    found = np.unique(epochs[epochs != _NEVER])
    if not len(found):
        return []
    groups = np.array_split(found, min(len(found), _MOST_COLOURS))
    return [_Age(int(g[0]), int(g[-1]), stamps[int(g[-1])]) for g in groups]
