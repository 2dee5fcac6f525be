"""A valid file for which there is too little memory is never taken for damaged."""

import subprocess
import sys
from collections import Counter

import zstandard
from fuzz.mcap_edit import RawRecord, checksummed, chunk, chunk_records, records_of
from support.map_records import random_record
from support.mapfile_edit import file_bytes
from triquad_format.mapfile.mcap.records import CHUNK

READ_WITH_LITTLE_MEMORY = """
import os
import resource
import sys
from pathlib import Path

from triquad_format.mapfile.reader import read_map

for room in range(0, 6 * 2**20, 2**16):
    if os.fork() == 0:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + room, resource.RLIM_INFINITY))
        try:
            read_map(sys.argv[1])
            outcome = b"read"
        except BaseException as error:
            outcome = type(error).__name__.encode()
        os.write(1, outcome + b"\\n")
        os._exit(0)
    os.wait()
"""


def streamed(data):
    """The file with its chunks compressed as by a writer that does not know their size before."""
    records = []
    for record in records_of(data):
        if record.opcode == CHUNK:
            inner = chunk_records(record)
            frame = zstandard.ZstdCompressor(write_content_size=False).compress(inner)
            head = chunk(inner, compressed=True).content[: 28 + 4 + len("zstd")]
            record = RawRecord(CHUNK, head + len(frame).to_bytes(8, "little") + frame)
        records.append(record)
    return checksummed(records)


def test_too_little_memory_is_no_damage(tmp_path):
    path = tmp_path / "map.triquad"
    path.write_bytes(streamed(file_bytes(random_record(3, points=20000))))
    command = [sys.executable, "-c", READ_WITH_LITTLE_MEMORY, str(path)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    outcomes = Counter(told.split())
    assert set(outcomes) == {"read", "TooLargeMapFileError"}, outcomes
