"""Files cut, overwritten and torn: what is intact comes back, and answers as before."""

import dataclasses
import io
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from support.files.checkpoint_folder import FIRST, SECOND, map_at, write_checkpoints
from support.files.file_damage import chunks, first_chunk, flipped, zeroed
from support.files.mapfile_edit import (
    edited,
    file_bytes,
    manifest_of,
    metadata_of,
    read_bytes,
    set_field,
)
from support.maps.map_records import SMALL, assert_same, random_record, with_rays, with_support
from triquad_format.errors import DamagedMapFileError, MapFileError, UnsupportedMapFileError
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    FIELD_TOPICS,
    MANIFEST,
    MAP,
    MOMENTS,
    PREVIEW,
    RAYS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
)
from triquad_format.mapfile.reader import read_map_file
from triquad_format.records import morton
from triquad_format.records.region import seen_voxels
from triquad_format.records.status import Status
from triquad_map.composition.composed_view import RecordedView
from triquad_map.view import FieldAnswer
from triquad_tools.mapfiles.crop import without_training
from triquad_tools.mapfiles.recovery import RecoveredMap, recover

SQUARES = dataclasses.replace(SMALL, depth=9)
"""A region of 128 m, of 2 x 2 squares."""

INDICES = ((0, 0, 0), (1, 0, 0))
RECORD = with_rays(with_support(random_record(5, settings=SQUARES, indices=INDICES, points=600)))
DATA = file_bytes(RECORD, preview=True, stamp_ns=10**18)


Recover = Callable[[bytes], RecoveredMap]


@pytest.fixture
def recovered(tmp_path: Path) -> Recover:
    def recover_bytes(data: bytes) -> RecoveredMap:
        path = tmp_path / "broken.triquad"
        path.write_bytes(data)
        return recover(path)

    return recover_bytes


@cache
def places() -> NDArray[np.float64]:
    """Points all over the regions, most of them where rays have been."""
    rng = np.random.default_rng(0)
    points = [rng.uniform(-1, 1.5, (1000, 3)) * SQUARES.region_side_m]
    for region in RECORD.regions:
        evidence = region.evidence
        voxels = seen_voxels(evidence, evidence.surface | evidence.free)
        voxels = voxels[rng.integers(len(voxels), size=2000)] + rng.uniform(size=(2000, 3))
        points.append(SQUARES.region_corner(region.index) + voxels * SQUARES.leaf_m)
    return np.concatenate(points)


@cache
def whole_answer() -> FieldAnswer:
    return RecordedView(RECORD).query(places())


def in_lost_regions(points: NDArray[np.float64], recovery: RecoveredMap) -> NDArray[np.bool_]:
    """Where the distance was blended with that of a region that is gone."""
    kept = {region.index for region in recovery.record.regions}
    inside = np.zeros(len(points), bool)
    for index in set(INDICES) - kept:
        offset = points - SQUARES.region_centre(index)
        inside |= (np.abs(offset) <= SQUARES.region_side_m / 2).all(axis=1)
    return inside


def assert_answers(recovery: RecoveredMap) -> None:
    """Where no loss reaches all is as before, and nothing that is known is wrong."""
    points, before = places(), whole_answer()
    after = RecordedView(recovery.record).query(points)
    known = after.status != Status.UNKNOWN
    known &= ~in_lost_regions(points, recovery)
    np.testing.assert_array_equal(after.sdf[known], before.sdf[known])
    # At the fringe of lost evidence SURFACE may become FREE.
    assert (after.status[known] <= before.status[known]).all()
    if recovery.parts_listed is None:
        return  # not all losses are known
    spared = np.ones(len(points), bool)
    margin = 2 * SQUARES.leaf_m
    for loss in recovery.losses:
        if loss.key.topic != TRAINING:
            low, high = loss.minimum - margin, loss.maximum + margin
            spared &= ~((points >= low) & (points <= high)).all(axis=1)
    np.testing.assert_array_equal(after.sdf[spared], before.sdf[spared])
    np.testing.assert_array_equal(after.status[spared], before.status[spared])


def test_an_intact_file_loses_nothing(recovered: Recover) -> None:
    recovery = recovered(DATA)
    assert recovery.complete
    assert recovery.losses == ()
    assert recovery.stamp_ns == 10**18
    assert_same(recovery.record, RECORD)


@pytest.mark.parametrize("topic", [VERTICES, EVIDENCE, REGION])
def test_a_lost_part_is_named_and_all_else_is_there(recovered: Recover, topic: str) -> None:
    listed = manifest_of(DATA).entries
    for number, chunk in enumerate(chunks(DATA)):
        if chunk.topic != topic:
            continue
        recovery = recovered(flipped(DATA, chunk.middle))
        field = [loss.key for loss in recovery.losses if loss.key.topic in FIELD_TOPICS]
        assert field == [listed[number].key]
        assert not recovery.complete
        assert recovery.parts_intact == recovery.parts_listed - 1
        assert_answers(recovery)


def test_outside_of_the_boxes_that_are_told_nothing_changes(recovered: Recover) -> None:
    """Also where surface was seen across the border of the box, and right beside it."""
    rng = np.random.default_rng(0)
    leaves = np.concatenate([np.full((300, 1), 255.0), rng.uniform(0, 512, (300, 2))], axis=1)
    seen = random_record(6, settings=SQUARES, points=4000).regions[0].evidence
    region = dataclasses.replace(RECORD.regions[0], evidence=seen, training=None)
    record = dataclasses.replace(RECORD, regions=(region,))
    data = file_bytes(record)
    recovery = recovered(flipped(data, first_chunk(data, VERTICES).middle))
    (loss,) = recovery.losses
    blocks = 8.0 * morton.decode(seen.codes, 3)
    places = np.tile(np.concatenate([blocks, blocks + 7, leaves]), (10, 1))
    places += rng.uniform(-1, 2, places.shape)
    points = SQUARES.region_corner(region.index) + places * SQUARES.leaf_m
    points = points[((points < loss.minimum) | (points > loss.maximum)).any(axis=1)]
    assert len(points) > 1000
    before, after = (RecordedView(one).query(points) for one in (record, recovery.record))
    np.testing.assert_array_equal(after.sdf, before.sdf)
    np.testing.assert_array_equal(after.status, before.status)


@pytest.mark.parametrize("topic", [TRAINING, MOMENTS, SAMPLES, RAYS])
def test_training_state_goes_where_it_is_not_complete(recovered: Recover, topic: str) -> None:
    recovery = recovered(flipped(DATA, first_chunk(DATA, topic).middle))
    assert [loss.key.topic for loss in recovery.losses] == [TRAINING]
    hurt, spared = recovery.record.regions
    assert hurt.training is None
    assert_same(spared, RECORD.regions[1])
    assert_same(without_training(recovery.record), without_training(RECORD))


@pytest.mark.parametrize("topic", [MAP, PREVIEW])
def test_parts_that_can_be_made_anew_are_no_loss(recovered: Recover, topic: str) -> None:
    recovery = recovered(flipped(DATA, first_chunk(DATA, topic).middle))
    assert recovery.complete
    assert_same(recovery.record, RECORD)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4, 0.55, 0.7, 0.85, 0.95])
def test_truncated_files(recovered: Recover, share: float) -> None:
    recovery = recovered(DATA[: int(len(DATA) * share)])
    assert not recovery.complete
    assert recovery.parts_listed is None
    assert recovery.parts_intact > 0
    assert_answers(recovery)


def test_what_is_left_of_a_file_is_a_map_of_a_part_of_the_world(recovered: Recover) -> None:
    record = without_training(dataclasses.replace(RECORD, regions=RECORD.regions[:1]))
    data = file_bytes(record)
    whole = RecordedView(record).status(places()) != Status.UNKNOWN
    shares = []
    for left in (0.3, 0.6, 0.9):
        kept = recovered(data[: int(left * len(data))]).record
        answer = RecordedView(kept).status(places()) != Status.UNKNOWN
        assert not (answer & ~whole).any()
        shares.append(float(answer.sum() / whole.sum()))
    assert 0.1 < shares[0] < shares[1] < shares[2] < 1


def test_a_file_cut_within_its_index_loses_nothing(recovered: Recover) -> None:
    end = chunks(DATA)[-1].end
    for cut in (end, end + 10, len(DATA) - 1):
        assert_same(recovered(DATA[:cut]).record, RECORD)


def test_without_its_front(recovered: Recover) -> None:
    first = first_chunk(DATA, REGION)
    assert_same(recovered(zeroed(DATA, 0, first.start)).record, RECORD)
    assert_same(recovered(DATA[first.start :]).record, RECORD)


def test_without_its_manifest(recovered: Recover) -> None:
    manifest = chunks(DATA)[-1]
    recovery = recovered(zeroed(DATA, manifest.start, manifest.end))
    assert not recovery.complete
    assert recovery.losses == ()
    assert_same(recovery.record, RECORD)


def test_lost_vertices_are_missed_without_a_manifest(recovered: Recover) -> None:
    *parts, manifest = chunks(DATA)
    for chunk in [chunk for chunk in parts if chunk.topic == VERTICES][::4]:
        corrupt = zeroed(DATA[: manifest.start], chunk.start, chunk.end)
        recovery = recovered(corrupt)
        assert [loss.key.topic for loss in recovery.losses].count(VERTICES) == 1
        assert_answers(recovery)


def test_without_front_and_manifest_nothing_tells_what_map_it_is(recovered: Recover) -> None:
    first, last = chunks(DATA)[1], chunks(DATA)[-1]
    with pytest.raises(MapFileError, match="nothing can be saved"):
        recovered(DATA[first.start : last.start])
    with pytest.raises(MapFileError, match="nothing can be saved"):
        recovered(b"")
    with pytest.raises(MapFileError, match="nothing can be saved"):
        recovered(np.random.default_rng(0).bytes(100_000))


def test_damage_anywhere(recovered: Recover) -> None:
    middle, rng = len(DATA) // 2, np.random.default_rng(3)
    mutants = [flipped(DATA, *rng.integers(0, len(DATA), 3).tolist()) for _ in range(15)]
    mutants += [zeroed(DATA, at, at + 4096) for at in range(0, len(DATA), len(DATA) // 12)]
    mutants.append(DATA[:middle] + b"\x06" * 999 + DATA[middle:])
    mutants.append(DATA[:middle] + DATA[middle + 999 :])
    for mutant in mutants:
        assert_answers(recovered(mutant))


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_a_file_rewritten_by_another_program(
    recovered: Recover, compression: CompressionType
) -> None:
    """Its parts are no longer where the manifest says, so that only this way of reading is left."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression)
    writer.start()
    reader = make_reader(io.BytesIO(DATA))
    writer.add_metadata("triquad", metadata_of(DATA))
    channels: dict[str, int] = {}
    for _, channel, message in reader.iter_messages(log_time_order=False):
        topic = channel.topic
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, channel.message_encoding, 0)
        writer.add_message(channels[topic], 0, message.data, 0)
    writer.finish()
    with pytest.raises(DamagedMapFileError, match="another program"):
        read_bytes(stream.getvalue())
    assert_same(recovered(stream.getvalue()).record, RECORD)


def test_a_newer_file_is_refused(recovered: Recover) -> None:
    newer = edited(DATA, MANIFEST, set_field("min_reader_version", 3))
    with pytest.raises(UnsupportedMapFileError, match="version 3"):
        recovered(newer[:-100])
    newer = edited(DATA, MAP, set_field("min_reader_version", 3))
    with pytest.raises(UnsupportedMapFileError, match="version 3"):
        recovered(newer[: len(newer) // 2])


def test_a_checkpoint_without_some_of_its_parts(tmp_path: Path) -> None:
    _, path = write_checkpoints(tmp_path, (3, 5))
    assert_same(recover(path).record, map_at(5))
    entries = read_map_file(path).manifest.entries
    head = next(e for e in entries if e.key.topic == REGION and e.key.region == FIRST)
    (tmp_path / "parts" / head.name).unlink()
    recovery = recover(path)
    assert [region.index for region in recovery.record.regions] == [SECOND]
    assert [(loss.key.topic, loss.key.region) for loss in recovery.losses] == [(REGION, FIRST)]
    assert recovery.parts_intact == len(entries) - 1
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(MapFileError, match="checksum"):
        recover(path)
