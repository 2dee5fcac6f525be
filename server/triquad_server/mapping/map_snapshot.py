"""The map as it was at a moment, from which any thread makes the records while mapping goes on."""

from dataclasses import dataclass, replace

import numpy as np
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord, Region, TrainingState

from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.ray_table import RayTable, draw_ordered_samples
from triquad_server.mapping.replay.replay_record import recorded_rays


@dataclass(frozen=True)
class RegionSnapshot:
    """A copy of what a record needs of a region.

    Finding the rays that a file holds, and their order, takes ten times as long as copying them.
    """

    region: Region  # without a training state
    training: TrainingState  # without rays and samples
    table: RayTable  # all kept rays: those to train on, then those that are held out
    trained: int  # how many are to train on
    setup: RegionSetup

    def record(self) -> Region:
        """Return the region with all of its training state as plain arrays."""
        setup = self.setup
        rays, others = recorded_rays(self.table, setup.field)
        others = others[others < self.trained]  # samples are for training
        rng = np.random.default_rng(len(others))
        # In place of what is no ray that ends in the cube.
        samples = draw_ordered_samples(self.table, others, setup.placement, rng, setup.team)
        training = replace(
            self.training,
            rays=rays,
            sample_points=samples.points,
            sample_labels=samples.labels.astype(np.float16),
        )
        return replace(self.region, training=training)


@dataclass(frozen=True)
class MapSnapshot:
    """The map as it was at a moment: of the regions that changed since another, what they hold."""

    changed: tuple[RegionSnapshot, ...]
    regions: tuple[RegionIndex, ...]  # all regions of the map
    epoch: Epoch  # the same state, for queries

    def record(self) -> MapRecord:
        """Return the changed regions with training state: a second for 100 m of a street."""
        return self.epoch.record(tuple(region.record() for region in self.changed))
