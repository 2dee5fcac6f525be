"""The map as it was at a moment, of which any thread makes the records while mapping goes on."""

from dataclasses import dataclass, replace

import numpy as np
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapRecord, Region, TrainingState
from triquad_map.compiled.team import Team

from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.replay.ray_table import Placement, RayTable, draw_ordered_samples
from triquad_server.mapping.replay.replay_record import recorded_rays


@dataclass(frozen=True)
class RegionSnapshot:
    """What a record takes, sharing nothing with the region.

    To find the rays that a file holds, and their order, takes ten times as long as to copy them.
    """

    region: Region  # without a training state
    training: TrainingState  # without rays and samples
    table: RayTable  # all that are kept: those to train on, then those that are held out
    trained: int  # how many are to train on
    placement: Placement  # of samples on what is no ray that ends in the cube
    settings: FieldSettings
    team: Team

    def record(self) -> Region:
        """The region with all of its training state as plain arrays."""
        rays, others = recorded_rays(self.table, self.settings)
        others = others[others < self.trained]  # samples are for training
        rng = np.random.default_rng(len(others))
        samples = draw_ordered_samples(self.table, others, self.placement, rng, self.team)
        training = replace(
            self.training,
            rays=rays,
            sample_points=samples.points,
            sample_labels=samples.labels.astype(np.float16),
        )
        return replace(self.region, training=training)


@dataclass(frozen=True)
class MapChanges:
    """What a checkpoint needs that follows another."""

    record: MapRecord  # of the regions that changed, with training state
    regions: tuple[RegionIndex, ...]  # all that there are
    epoch: Epoch  # the same state, for questions


@dataclass(frozen=True)
class MapSnapshot:
    """What changed, as it was at a moment."""

    name: str
    settings: FieldSettings
    changed: tuple[RegionSnapshot, ...]
    regions: tuple[RegionIndex, ...]  # all that there are
    epoch: Epoch  # the same state

    def changes(self) -> MapChanges:
        """The records of it, which take a second for 100 m of a street."""
        regions = tuple(region.record() for region in self.changed)
        epoch = self.epoch
        record = MapRecord(self.name, epoch.number, self.settings, regions, progress=epoch.progress)
        return MapChanges(record, self.regions, epoch)
