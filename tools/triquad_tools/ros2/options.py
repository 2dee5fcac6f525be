"""Options of the bridge."""

from dataclasses import dataclass, field

import numpy as np
from triquad_client import Bounds
from triquad_format.records.arrays import Doubles

from triquad_tools.ros2.topic_choice import TopicChoice

MAX_GRID_CELLS = 250_000


@dataclass(frozen=True)
class ScanOptions:
    """Options for turning messages into scans."""

    depth_stride: int = 2  # every how many rows and columns of a depth image one is taken
    body_frame: str = "base_link"  # whose pose a topic of PoseStamped gives
    map_frame: str = ""  # "": map, odom or world, the first that the transforms have
    by_arrival: bool = False  # stamps are when messages arrived, not those of their headers
    wait_s: float = 2.0  # for how long a scan waits for its transforms


@dataclass(frozen=True)
class SliceShape:
    """The slice of the map that is published as an occupancy grid."""

    height_m: float = 0.5  # in the map frame
    side_m: float = 40.0
    cell_m: float = 0.1

    @property
    def cells(self) -> int:
        """The cells along each side."""
        return max(1, round(self.side_m / self.cell_m))

    def around(self, position_m: Doubles) -> Bounds:
        """Return the corners of a flat box around a position [3], on a lattice that stays."""
        first = np.round(position_m[:2] / self.cell_m) - self.cells // 2
        low, high = first * self.cell_m, (first + self.cells) * self.cell_m
        return [*low.tolist(), self.height_m], [*high.tolist(), self.height_m]


@dataclass(frozen=True)
class BridgeOptions:
    """All options of the bridge."""

    topics: TopicChoice = field(default_factory=TopicChoice)
    scans: ScanOptions = field(default_factory=ScanOptions)
    grid: SliceShape = field(default_factory=SliceShape)
    mesh_level: int = 1  # of detail: cells are twice as large at each
    mesh_bytes_per_s: int = 5_000_000  # of markers, at most
