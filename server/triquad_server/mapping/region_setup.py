"""The setup that the regions of a map share."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_map.compiled.team import Team

from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.memory import Memory
from triquad_server.mapping.replay.ray_table import Placement
from triquad_server.settings import ChangeSettings, ScanSettings, TrainingSettings


@dataclass(frozen=True)
class RegionSetup:
    """The setup that the regions of a map share."""

    field: FieldSettings
    scan: ScanSettings
    change: ChangeSettings
    training: TrainingSettings
    memory: Memory  # of the fields
    sums: GradientSums
    team: Team

    @property
    def placement(self) -> Placement:
        """Return where on their rays samples lie."""
        return Placement(
            surface_share=self.scan.surface_share,
            spread_m=self.scan.spread_m,
            behind_m=self.scan.behind_m,
            half_side_m=self.field.region_side_m / 2,
        )

    def seeds(self, index: RegionIndex) -> tuple[int, int]:
        """Return seeds of a region's field and of its replay pool; no two regions share one."""
        natural = tuple(2 * i if i >= 0 else -2 * i - 1 for i in index)
        sequence = np.random.SeedSequence(self.training.seed, spawn_key=natural)
        field, pool = sequence.generate_state(2, np.uint64).tolist()
        return field, pool
