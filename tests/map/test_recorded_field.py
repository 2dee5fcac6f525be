import dataclasses
import itertools
import math

import numpy as np
import pytest
from support.maps.map_records import SMALL, evidence_of, random_record
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, MapRecord, VertexTable
from triquad_format.records.status import Status
from triquad_map.composition.recorded_view import RecordedView
from triquad_map.view import NotAskedError

PAIR = ((0, 0, 0), (1, 0, 0))
CUBE = tuple(itertools.product((0, 1), repeat=3))


class SlowField:
    """The specification point by point, in Python numbers and dictionaries."""

    def __init__(self, record):
        self.settings = record.settings
        self.regions = {region.index: region for region in record.regions}
        self.vertices = {
            (region.index, table.plane, table.level): {
                int(code): [float(x) for x in row]
                for code, row in zip(table.codes, table.features, strict=True)
            }
            for region in record.regions
            for table in region.tables
        }

    def sdf(self, point):
        s = self.settings
        total = value = 0.0
        for index in self.regions:
            offset = [p - i * s.region_pitch_m for p, i in zip(point, index, strict=True)]
            weight = 1.0
            for d in offset:
                weight *= min(max((s.region_side_m / 2 - abs(d)) / s.overlap_m, 0.0), 1.0)
            if weight > 0:
                total += weight
                value += weight * self.field(index, offset)
        return value / total if total else math.nan

    def field(self, index, local):
        s, region = self.settings, self.regions[index]
        inputs = []
        if s.encoding != "fourier":
            for level in s.levels:
                inputs += self.features(index, level, local)
        if s.encoding != "features":
            for function in (math.sin, math.cos):
                for x in local:
                    turns = 2 * math.pi * x / (s.region_side_m / 2)
                    inputs += [function(turns * float(f)) for f in region.frequencies]
        for layer, (weight, bias) in enumerate(
            zip(region.mlp.weights, region.mlp.biases, strict=True)
        ):
            outputs = [
                sum(x * float(w) for x, w in zip(inputs, weight[:, j], strict=True)) + float(b)
                for j, b in enumerate(bias)
            ]
            inputs = outputs if layer == 2 else [max(y, 0.0) for y in outputs]
        return inputs[0] * s.logit_scale_m

    def features(self, index, level, local):
        s = self.settings
        sums = [0.0] * s.feature_size
        for plane, axes in enumerate(AXES):
            side = 2 ** (s.depth - level)
            v = [(local[axis] / s.leaf_m + 2 ** (s.depth - 1)) / side for axis in axes]
            a, b = (math.floor(x) for x in v)
            for i, j in itertools.product((0, 1), repeat=2):
                weight = (1 - abs(v[0] - a - i)) * (1 - abs(v[1] - b - j))
                code = sum(
                    (a + i >> bit & 1) << 2 * bit | (b + j >> bit & 1) << 2 * bit + 1
                    for bit in range(20)
                )
                row = self.vertices[index, plane, level].get(code)
                if row is not None:
                    sums = [x + weight * y for x, y in zip(sums, row, strict=True)]
        return sums

    def status(self, point):
        s = self.settings
        index = tuple(math.floor(p / s.region_pitch_m + 0.5) for p in point)
        if index not in self.regions:
            return Status.UNKNOWN
        u = [
            (p - i * s.region_pitch_m) / s.leaf_m + 2 ** (s.depth - 1)
            for p, i in zip(point, index, strict=True)
        ]
        evidence = self.regions[index].evidence
        for shift in itertools.product((-0.5, 0.5), repeat=3):
            voxel = [math.floor(x + d) for x, d in zip(u, shift, strict=True)]
            if self.bit(evidence, evidence.surface, voxel):
                return Status.SURFACE
        seen = self.bit(evidence, evidence.free, [math.floor(x) for x in u])
        return Status.FREE if seen else Status.UNKNOWN

    def bit(self, evidence, masks, voxel):
        for row, code in enumerate(evidence.codes):
            if morton.decode(np.array(code), 3).tolist() == [x // 8 for x in voxel]:
                x, y, z = (c % 8 for c in voxel)
                return masks[row, x * 8 + y] >> z & 1
        return 0


def points_around(record, count, seed=1):
    """Points [N, 3] within the regions' cubes and a little beyond."""
    rng = np.random.default_rng(seed)
    centres = np.array([region.index for region in record.regions])
    low, high = centres.min(axis=0), centres.max(axis=0)
    s = record.settings
    margin = s.region_side_m / 2 + 1
    return rng.uniform(
        low * s.region_pitch_m - margin, high * s.region_pitch_m + margin, (count, 3)
    )


def surface_points(record, count):
    """Centres [N, 3] of voxels in which the first region saw a surface."""
    s, region = record.settings, record.regions[0]
    row, octet, z = np.nonzero(
        np.unpackbits(region.evidence.surface[..., None], axis=2, bitorder="little")
    )
    inner = np.column_stack([octet // 8, octet % 8, z])
    voxels = morton.decode(region.evidence.codes[row], 3) * 8 + inner
    offset = (voxels + 0.5) * s.leaf_m - s.region_side_m / 2
    return (offset + np.array(region.index) * s.region_pitch_m)[:count]


@pytest.mark.parametrize("encoding", ["both", "features", "fourier"])
@pytest.mark.parametrize("indices", [((0, 0, 0),), PAIR, CUBE, ((-3, 2, 0),)])
def test_agrees_with_slow_field(encoding, indices):
    settings = dataclasses.replace(SMALL, encoding=encoding)
    record = random_record(3, settings=settings, indices=indices, points=300, feature_dtype="<f4")
    points = np.concatenate([points_around(record, 100), surface_points(record, 50)])
    slow = SlowField(record)
    answer = RecordedView(record).query(points)
    assert answer.sdf.dtype == np.float32
    with pytest.raises(NotAskedError):
        _ = answer.gradient
    np.testing.assert_allclose(answer.sdf, [slow.sdf(p) for p in points.tolist()], atol=2e-5)
    assert answer.status.tolist() == [slow.status(p) for p in points.tolist()]
    assert set(answer.status.tolist()) == set(Status)


def test_agrees_with_slow_field_at_default_settings():
    record = random_record(4, settings=FieldSettings(), points=500)
    corners = SlowField(record)
    rng = np.random.default_rng(0)
    table = record.regions[0].tables[2]
    xy = morton.decode(table.codes[rng.integers(0, len(table.codes), 40)], 2) * 0.2 - 409.6
    points = np.column_stack([xy, rng.uniform(-400, 400, 40)]) + rng.uniform(-0.2, 0.2, (40, 3))
    answer = RecordedView(record).query(points)
    np.testing.assert_allclose(answer.sdf, [corners.sdf(p) for p in points.tolist()], atol=1e-5)


def test_gradient_is_that_of_the_field():
    """Central differences of the slow field, away from the kinks of hats and ReLUs."""
    record = random_record(5, indices=CUBE, feature_dtype="<f4")
    points = points_around(record, 200)
    slow = SlowField(record)
    answer = RecordedView(record).query(points, gradient=True)
    step = 1e-5
    agree = 0
    for point, slope in zip(points, answer.gradient, strict=True):
        for axis in range(3):
            h = np.eye(3)[axis] * step
            left, middle, right = (slow.sdf((point + k * h).tolist()) for k in (-1, 0, 1))
            if math.isnan(left + middle + right):
                continue
            one, other = (middle - left) / step, (right - middle) / step
            if abs(one - other) < 1e-2:
                assert slope[axis] == pytest.approx((right - left) / (2 * step), abs=5e-3)
                agree += 1
    assert agree > 400


def test_gradient_leaves_values_alone():
    record = random_record(6, indices=PAIR)
    points = points_around(record, 100)
    plain = RecordedView(record).query(points)
    both = RecordedView(record).query(points, gradient=True)
    np.testing.assert_array_equal(plain.sdf, both.sdf)
    np.testing.assert_array_equal(np.isnan(both.gradient).all(axis=1), np.isnan(plain.sdf))


def test_no_step_across_two_regions():
    record = random_record(7, indices=PAIR)
    s = record.settings
    x = np.linspace(-2, s.region_pitch_m + 2, 20_001)
    points = np.column_stack([x, np.full_like(x, 0.3), np.full_like(x, -0.4)])
    sdf = RecordedView(record).query(points).sdf
    alone = [
        RecordedView(dataclasses.replace(record, regions=(region,))).query(points).sdf
        for region in record.regions
    ]
    step = np.abs(np.diff(sdf)).max()
    assert step < 20 * np.median(np.abs(np.diff(sdf))) + 1e-3
    first_only = x < s.region_pitch_m - s.region_side_m / 2
    second_only = x > s.region_side_m / 2
    np.testing.assert_array_equal(sdf[first_only], alone[0][first_only])
    np.testing.assert_array_equal(sdf[second_only], alone[1][second_only])
    middle = np.argmin(np.abs(x - s.region_pitch_m / 2))
    assert sdf[middle] == pytest.approx((alone[0][middle] + alone[1][middle]) / 2, abs=2e-3)


def test_outside_all_regions():
    record = random_record(8)
    answer = RecordedView(record).query(np.array([[100.0, 0, 0], [1e300, 0, 0]]), gradient=True)
    assert np.isnan(answer.sdf).all()
    assert np.isnan(answer.gradient).all()
    assert answer.status.tolist() == [Status.UNKNOWN] * 2


def test_empty_map_and_no_points():
    empty = RecordedView(MapRecord("default", 0, SMALL, ()))
    assert np.isnan(empty.query(np.zeros((2, 3))).sdf).all()
    answer = RecordedView(random_record()).query(np.zeros((0, 3)), gradient=True)
    assert answer.sdf.shape == answer.status.shape == (0,)
    assert answer.gradient.shape == (0, 3)


def with_evidence(surface_voxels, free_voxels):
    """A record whose only evidence is in these voxels."""
    voxels = np.array([*surface_voxels, *free_voxels])
    codes = np.unique(morton.encode(voxels // 8))
    masks = np.zeros((2, len(codes), 64), np.uint8)
    for kind, chosen in enumerate((surface_voxels, free_voxels)):
        for x, y, z in chosen:
            row = np.searchsorted(codes, morton.encode(np.array([x, y, z]) // 8))
            masks[kind, row, x % 8 * 8 + y % 8] |= 1 << z % 8
    record = random_record(9)
    evidence = evidence_of(codes, masks[0], masks[1])
    region = dataclasses.replace(record.regions[0], evidence=evidence)
    return dataclasses.replace(record, regions=(region,))


def test_status_reaches_half_a_voxel():
    engine = RecordedView(with_evidence([(40, 33, 31)], [(10, 10, 10), (40, 33, 31)]))
    centre = (np.array([40.5, 33.5, 31.5]) - 32) * SMALL.leaf_m
    reach = 1.0 * SMALL.leaf_m  # half the voxel, and half a voxel more
    for axis, sign in itertools.product(range(3), (-1, 1)):
        step = np.eye(3)[axis] * sign
        near, far = centre + step * (reach - 1e-6), centre + step * (reach + 1e-6)
        assert engine.query(np.array([near, far])).status.tolist() == [
            Status.SURFACE,
            Status.UNKNOWN,
        ]
    free = (np.array([[10.5, 10.5, 10.5], [10.5, 10.5, 11.5]]) - 32) * SMALL.leaf_m
    assert engine.query(free).status.tolist() == [Status.FREE, Status.UNKNOWN]


def test_ghost_cells_are_unknown():
    """Where the planes alias, the field answers, but the status does not believe it."""
    seen = [(20, 30, 40), (20, 45, 50), (35, 30, 50)]
    ghost = (20, 30, 50)  # its three projections are all occupied
    for a, b in AXES:
        assert (ghost[a], ghost[b]) in [(v[a], v[b]) for v in seen]
    answer = RecordedView(with_evidence(seen, [])).query(
        (np.array([*seen, ghost]) + 0.5 - 32) * SMALL.leaf_m
    )
    assert np.isfinite(answer.sdf).all()
    assert answer.status.tolist() == [Status.SURFACE] * 3 + [Status.UNKNOWN]


def test_status_is_of_the_owner():
    """In an overlap the nearer region's evidence counts, and only that."""
    record = random_record(10, indices=PAIR)
    seen = record.regions[1].evidence
    blank = evidence_of(seen.codes, seen.free * 0, seen.free * 0)
    full = dataclasses.replace(
        record.regions[0],
        evidence=evidence_of(
            np.arange(512), np.full((512, 64), 255, np.uint8), np.full((512, 64), 255, np.uint8)
        ),
    )
    other = dataclasses.replace(record.regions[1], evidence=blank)
    both = RecordedView(dataclasses.replace(record, regions=(full, other)))
    border = record.settings.region_pitch_m / 2
    points = np.array([[border - 1e-9, 0, 0], [border, 0, 0]])
    assert both.query(points).status.tolist() == [Status.SURFACE, Status.UNKNOWN]


def test_table_without_vertices():
    record = random_record(12)
    region = record.regions[0]
    tables = tuple(
        VertexTable(t.plane, t.level, t.codes[:0], t.features[:0]) for t in region.tables
    )
    bare = dataclasses.replace(record, regions=(dataclasses.replace(region, tables=tables),))
    assert np.isfinite(RecordedView(bare).query(np.zeros((3, 3)), gradient=True).sdf).all()
