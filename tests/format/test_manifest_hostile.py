"""Manifests whose checksums and digests are all right, but whose values are not."""

import dataclasses

import numpy as np
import pytest
from support.map_records import random_record
from support.mapfile_edit import (
    assert_refused,
    edited,
    file_bytes,
    read_bytes,
    set_field,
    stored,
    with_manifest,
)
from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.parts.part import MANIFEST

DATA = file_bytes(random_record(12))


def column(name, number, value):
    def edit(body):
        packed = body["parts"][name]
        array = np.frombuffer(packed["data"], packed["dtype"]).reshape(packed["shape"]).copy()
        array[number] = value
        packed["data"] = array.tobytes()

    return edit


HOSTILE_MANIFESTS = {
    "topic": column("topic", 1, 200),
    "file": column("file", 1, 1),
    "plane": column("plane", 2, 3),
    "cell": column("cell", 2, -1),
    "a cell that is not there": column("cell", 2, 2**60),
    "size": column("bytes", 1, 2**62),
    "digest": column("sha256", 1, 0),
    "epoch": column("epoch", 1, -1),
    "time": column("stamp_ns", 1, -1),
    "another region": column("region", 2, 9),
    "a column less": lambda b: b["parts"].pop("cell"),
    "a column of another dtype": lambda b: b["parts"]["plane"].update(dtype="|i1"),
    "a shorter column": lambda b: b["parts"].update(plane=b["parts"]["plane"] | {"shape": [1]}),
    "a topic that is no text": lambda b: b["topics"].__setitem__(0, 5),
    "files that are no maps": set_field("files", [1]),
    "a short digest": set_field("files", [{"name": "a", "manifest": b"1"}]),
    "a file twice": set_field("files", 2 * [{"name": "a", "manifest": bytes(32)}]),
    "time of creation": set_field("created_ns", -1),
}


@pytest.mark.parametrize("case", HOSTILE_MANIFESTS)
def test_hostile_manifests(case):
    assert_refused(edited(DATA, MANIFEST, HOSTILE_MANIFESTS[case]))


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../a.triquad", "/etc/passwd", "a\\b", "a\0b", "x" * 256]
)
def test_manifests_name_files_not_paths(name):
    file = [{"name": name, "manifest": bytes(32)}]
    mutant = edited(DATA, MANIFEST, set_field("files", file))
    with pytest.raises(DamagedMapFileError, match="not the name of a file"):
        read_bytes(mutant)


def test_parts_of_a_region_without_a_head(tmp_path):
    """Queries, boxes and whole reads must all mind that the region is not there."""

    def elsewhere(manifest):
        key = dataclasses.replace(manifest.own[2].key, region=(9, 9, 9))
        listed_elsewhere = dataclasses.replace(
            manifest.own[2], key=key, file=FileRef("other.triquad", bytes(32))
        )
        return dataclasses.replace(manifest, entries=(*manifest.entries, listed_elsewhere))

    mutant = with_manifest(DATA, elsewhere)
    with pytest.raises(DamagedMapFileError, match=r"region of \(9, 9, 9\) is missing"):
        read_bytes(mutant)
    with pytest.raises(DamagedMapFileError, match=r"region of \(9, 9, 9\) is missing"):
        stored(mutant)
