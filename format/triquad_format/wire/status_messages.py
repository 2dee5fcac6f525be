"""The wire messages in which a server tells its status; see :mod:`triquad_format.wire.messages`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from triquad_format.wire import keys
from triquad_format.wire.bounds import rows_of, within
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.messages import (
    CheckpointInfo,
    Count,
    Duration,
    Epoch,
    FinitePoints,
    Length,
    Lengths,
    Name,
    Origin,
)


@dataclass(frozen=True)
class FieldFit(Message):
    """The fit of the field to rays that it is never trained on, by place: a cube of 32 leaves.

    The field should be zero where such a ray ends; medians are of how far it is from that, the
    sensor's noise included.
    """

    rays: Count
    median_m: Length  # of all these rays
    upper_m: Length  # what 90 % of them keep below
    worst: FinitePoints  # [K, 3] map frame, metres: centres of the places with the largest medians
    worst_median_m: Annotated[Lengths, rows_of("worst")]  # [K]

    def __repr__(self) -> str:
        return f"FieldFit({self.rays} rays: median {1e3 * self.median_m:.1f} mm)"


@dataclass(frozen=True)
class KeptScans(Message):
    """The scans that the server keeps with its checkpoints, and how far back they are corrected."""

    bytes: Count  # of their files
    max_bytes: Annotated[int, within(0)]  # beyond which the oldest files are deleted
    # The stamp of the first scan whose pose can be corrected, nanoseconds since 1970; None: there
    # is no such scan.
    since_ns: int | None

    def __repr__(self) -> str:
        return f"KeptScans({self.bytes / 1e6:.1f} MB; {self.told})"

    @property
    def told(self) -> str:
        """From when on poses can be corrected, in words."""
        if self.since_ns is None:
            return "no pose can be corrected"
        return f"poses since {self.since_ns / 1e9:.3f} s can be corrected"


@dataclass(frozen=True)
class ServerStatus(Message):
    """Answer to :class:`StatusRequest`; also put on ``triquad/<map>/status``."""

    map_name: Name
    server: Name  # a name of this server process
    version: Name
    device: Name
    epoch: Epoch
    settled: bool  # True: nothing is left to learn from the scans so far
    scans_taken: Count  # that are in the map, also those before a restart
    scans_dropped: dict[Name, Count]  # by reason
    scans_lost: dict[Name, Count]  # by source: never arrived, or pushed out of the full queue
    scans_waiting: Count
    points_dropped: dict[Name, Count]  # by reason, points and rays of scans that were accepted
    requests_refused: dict[Name, Count]  # by error code
    samples_trained: Count  # of the map, likewise
    rays_kept: Count  # rays whose lessons are in the replay pools
    loss: Annotated[float, within()]  # recent training loss, 0 before any training
    regions: Count
    vertices: Count
    parameters: Count
    memory_bytes: Count  # resident memory of the server process
    uptime_s: Duration
    last_checkpoint: CheckpointInfo | None
    store_error: str | None  # why the map is not durable, None if it is
    warnings: tuple[str, ...] = ()  # what goes wrong with scans, and what helps
    samples_left: Count = 0  # training samples until nothing is left to learn
    map_bytes: Count = 0  # memory of the map with its rays and its newest epoch, an estimate
    map_max_bytes: Count = 0  # that the server may take in all; 0: not known
    fit: FieldFit | None = None  # of regions in memory, as judged last; None: none was
    rays_discarded: Count = 0  # that gave way to others, since the server started
    replay_share: Annotated[float, within(0, 1)] = 1.0
    """The share of the rays that each place is to keep for which memory has room."""

    samples_discarded: Count = 0  # above the limit of a region's training budget
    origin_m: Origin | None = None  # [3] from where the map itself counts; None: from 0 0 0
    kept_scans: KeptScans | None = None  # None: none are kept
    memory_parts: dict[Name, Count] = field(default_factory=dict)  # bytes, by what takes them
    regions_cold: Count = 0  # of the regions, those that are read from the store where needed
    correcting: Count = 0  # scans whose poses are being corrected: regions are made again
    region_pitch_m: Length = 0.0  # from the middle of a region to that of the next; 0: not told

    def __repr__(self) -> str:
        told = f"{self.scans_taken} scans, {self.learnt_percent} % learnt; epoch {self.epoch}"
        kept = "" if self.kept_scans is None else f"; {self.kept_scans.told}"
        return f"ServerStatus(map {self.map_name!r}: {told}{kept})"

    @property
    def learnt_percent(self) -> int:
        """How much is learnt of what the scans so far can teach, 0 to 100; 100: it is settled."""
        in_all = self.samples_trained + self.samples_left
        return 100 if self.settled else min(100 * self.samples_trained // max(in_all, 1), 99)


@dataclass(frozen=True)
class StatusRequest(Request[ServerStatus], operation=keys.STATUS):
    """Ask how the server is doing."""
