"""A region as plain arrays: what the map file contains and what the evaluator reads.

:mod:`triquad_format.records.field_settings` says where it lies and what its coordinates are. At
level ``l`` a node has side ``2**(depth - l)`` leaves; vertex ``(a, b)`` of a plane lies at
``(a, b) * 2**(depth - l)``. Evidence voxels have the side of a leaf.
"""

import math
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import FormatError
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.replay_rays import ReplayRays, no_rays

AXES = ((0, 1), (0, 2), (1, 2))
"""Coordinate axes of the planes XY, XZ and YZ."""

BLOCK_BYTES = BLOCK_VOXELS**3 // 8
"""Bytes of one bit mask of a block: voxel (x, y, z) is bit ``z`` of byte ``x * 8 + y``."""

MAX_LEVEL = 7
"""The level of the best supported surface."""

MAX_SEEN_S = (2**63 - 1) // 10**9
"""The latest time of a surface: stamps are nanoseconds below ``2**63``."""

MARGIN_BITS = (2,) * 6
"""Bits of the margins of a surface voxel, one for each of its sides."""

OUTCOME_BITS = (2, 4, 4)
"""Bits of the codes for how often rays hit, passed and missed a surface voxel."""

MAX_INTEGER = 32_639
"""Largest integer feature: its two bytes, both signed, reach no further."""

MLP_LAYERS = 3

NO_ORIGIN = (0.0, 0.0, 0.0)
"""Of a map that counts from where its user does."""

FLOATS = ("<f2", "<f4")
"""Precisions of long columns of floats."""

_BITS_SET = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype="u1")


@dataclass(frozen=True)
class VertexTable:
    """The vertices of one plane and level with their feature vectors."""

    plane: int
    level: int
    codes: Longs  # [V] Morton codes of (a, b), strictly increasing
    features: NDArray[np.floating | np.int16]  # [V, feature_size]
    scale: float | None = None  # of integer features: one step, in single precision

    def vectors(self) -> Floats:
        """Return the feature vectors [V, feature_size]: integers count steps of ``scale``."""
        vectors = self.features.astype(np.float32)
        return vectors if self.scale is None else vectors * np.float32(self.scale)


@dataclass(frozen=True)
class Mlp:
    """Weights of the decoder: three dense layers, ``y = x @ weight + bias``, ReLU between."""

    weights: tuple[Floats, ...]  # [input, hidden], [hidden, hidden], [hidden, 1]
    biases: tuple[Floats, ...]  # [hidden], [hidden], [1]


@dataclass(frozen=True)
class Evidence:
    """The evidence of rays, as bit masks of voxels with the side of a leaf, in sparse blocks."""

    codes: Longs  # [B] 3-D Morton codes of blocks, strictly increasing
    surface: Bytes  # [B, BLOCK_BYTES] a ray ended in the voxel
    free: Bytes  # [B, BLOCK_BYTES] a ray passed through the voxel
    levels: Bytes
    """[S] How well each surface voxel is supported, from 0 to ``MAX_LEVEL``.

    In the order of :func:`seen_voxels`. What a level stands for is up to those who set and read
    it; a higher one is better supported.
    """
    seen_s: Longs
    """[B] When a ray last ended in the block: whole seconds since 1970, by the stamps of scans.

    0 where none did, or it is not known.
    """
    outcomes: Bytes
    """[S, 3] Codes of how often rays hit, passed and missed each surface voxel.

    In the order of :func:`seen_voxels`. ``docs/map-file.md`` says what the codes stand for; they
    are 0 where nothing is known.
    """
    margins: Bytes
    """[S, 6] On each side of each surface voxel, how many quarters of it lie beyond all ends.

    In the order of :func:`seen_voxels`; the sides towards lesser x, y, z, then towards greater
    ones. 0 as well where the surface goes on beyond that side, or too few scans hit the voxel to
    decide.
    """


@dataclass(frozen=True)
class TrainingState:
    """The state that training needs beyond the field, to go on as if it had not stopped.

    Adam's moments follow the order of the tables' rows and of the MLP's arrays. Samples show what
    no ray does: that a surface was removed.
    """

    table_means: tuple[NDArray[np.floating], ...]  # per table [V, feature_size]
    table_variances: tuple[NDArray[np.floating], ...]  # per table [V, feature_size]
    table_steps: tuple[Ints, ...]  # per table [V] steps that each row took
    mlp_means: tuple[Floats, ...]  # weights, then biases
    mlp_variances: tuple[Floats, ...]
    mlp_steps: int
    sample_points: Floats  # [S, 3] replay samples, metres from the region's centre
    sample_labels: NDArray[np.floating]  # [S] signed distance, metres
    budget_samples: int  # training budget: samples still to be trained on; 0: all is learnt
    rays: ReplayRays = field(default_factory=no_rays)


@dataclass(frozen=True)
class Region:
    """One region of a map, complete."""

    index: RegionIndex
    frequencies: Floats  # [m] Fourier frequencies s_i
    mlp: Mlp
    tables: tuple[VertexTable, ...]  # plane-major: (plane 0, coarsest level), ...
    evidence: Evidence
    training: TrainingState | None

    @property
    def parameters(self) -> int:
        """Learnable numbers: features, weights and biases."""
        features = sum(table.features.size for table in self.tables)
        return features + sum(array.size for array in (*self.mlp.weights, *self.mlp.biases))


@dataclass(frozen=True)
class MapProgress:
    """The progress of a map. It goes on with the map, whichever process goes on with it."""

    scans_taken: int = 0
    samples_trained: int = 0
    loss: float = 0.0  # recent training loss; 0 before any training

    def check(self) -> None:
        """Raise :class:`FormatError`, naming the field, unless the numbers are possible."""
        for name in ("scans_taken", "samples_trained"):
            if not 0 <= getattr(self, name) < 2**62:
                raise FormatError(f"{name} = {getattr(self, name)} is not a count below 2**62")
        if not (math.isfinite(self.loss) and self.loss >= 0):
            raise FormatError(f"loss = {self.loss} is not a loss: use a finite number from 0 on")


@dataclass(frozen=True)
class MapRecord:
    """A map at one epoch: the content of a map file."""

    name: str
    epoch: int
    settings: FieldSettings
    regions: tuple[Region, ...]
    progress: MapProgress = MapProgress()
    # [3] of the coordinates that its user gives: from there all else in the record counts
    origin_m: tuple[float, float, float] = NO_ORIGIN

    @property
    def facts(self) -> "MapRecord":
        """The map without its regions."""
        return replace(self, regions=())

    @property
    def origin(self) -> Doubles:
        """[3] metres: :attr:`origin_m`."""
        return np.array(self.origin_m)

    @property
    def learnt_percent(self) -> int | None:
        """How much is learnt of what the scans can teach; ``None``: no training state says it."""
        states = [region.training for region in self.regions if region.training is not None]
        left, done = sum(state.budget_samples for state in states), self.progress.samples_trained
        percent = min(100 * done // (done + left), 99) if left else 100
        return percent if states else None

    @property
    def has_evidence(self) -> bool:
        """True where rays have shown anything; without evidence all is ``UNKNOWN``."""
        return any(len(region.evidence.codes) for region in self.regions)


def no_evidence() -> Evidence:
    """Return evidence of a region of which rays have shown nothing."""
    masks, none = np.zeros((0, BLOCK_BYTES), np.uint8), np.zeros(0, np.int64)
    outcomes, margins = (np.zeros((0, len(bits)), np.uint8) for bits in (OUTCOME_BITS, MARGIN_BITS))
    return Evidence(none, masks, masks, np.zeros(0, np.uint8), none, outcomes, margins)


def seen_voxels(evidence: Evidence, masks: Bytes) -> Longs:
    """Return voxels [N, 3] of a region whose bit is set in evidence ``masks`` [B, BLOCK_BYTES]."""
    bits = np.unpackbits(masks, axis=1, bitorder="little")
    rows, voxel = np.nonzero(bits)
    inner = np.stack(np.unravel_index(voxel, (BLOCK_VOXELS,) * 3), axis=1)
    blocks: Longs = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS
    return blocks + inner


def used_blocks(masks: Bytes) -> NDArray[np.intp]:
    """Return rows of ``masks`` [B, BLOCK_BYTES] with any bit set."""
    # Of surface most rows are empty: they are of open air. Eight bytes at a time, by columns, takes
    # a quarter of the time of ``any``.
    return np.flatnonzero(reduce(np.bitwise_or, masks.view(np.uint64).T))


def surface_counts(surface: Bytes) -> Longs:
    """Return numbers [B] of surface voxels in blocks with these masks [B, BLOCK_BYTES]."""
    counts = np.zeros(len(surface), np.int64)
    used = used_blocks(surface)
    counts[used] = _BITS_SET[surface[used]].sum(axis=1, dtype=np.int64)
    return counts


def masked(evidence: Evidence, mask: Bytes) -> Evidence:
    """Return the evidence of the voxels whose bit is set in ``mask`` [B, BLOCK_BYTES]."""
    surface, free = evidence.surface & mask, evidence.free & mask
    rows = np.flatnonzero((surface | free).any(axis=1))
    before, after = (
        np.unpackbits(bits, bitorder="little").astype(bool) for bits in (evidence.surface, surface)
    )
    kept = after[before]
    return Evidence(
        evidence.codes[rows],
        surface[rows],
        free[rows],
        levels=evidence.levels[kept],
        seen_s=np.where(surface.any(axis=1), evidence.seen_s, 0)[rows],
        outcomes=evidence.outcomes[kept],
        margins=evidence.margins[kept],
    )


def owned_evidence(settings: FieldSettings, region: Region) -> Evidence:
    """Return the evidence that answers of the region depend on, without its neighbours' space."""
    blocks, mine = morton.decode(region.evidence.codes, 3), settings.owned_blocks
    owned = ((blocks >= mine.start) & (blocks < mine.stop)).all(axis=1, keepdims=True)
    return masked(region.evidence, np.where(owned, np.uint8(0xFF), np.uint8(0)))


def surface_voxels(record: MapRecord) -> Doubles:
    """Return middles [N, 3] of the voxels in which rays ended, metres from the map's origin."""
    settings, parts = record.settings, [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(settings, region)
        voxels = seen_voxels(evidence, evidence.surface)
        parts.append(settings.region_corner(region.index) + (voxels + 0.5) * settings.leaf_m)
    return np.concatenate(parts)
