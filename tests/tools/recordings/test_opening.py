import errno
from argparse import ArgumentParser

import numpy as np
import pytest
from support.recordings.kitti_folder import write_folder
from triquad_tools.console.command import ToolError
from triquad_tools.mapping.output import why
from triquad_tools.recordings.opening import open_recording, open_selected
from triquad_tools.recordings.recording import ReadingOptions, add_recording


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("a.zip", "unzip"),
        ("a.tar.gz", "tar -xf"),
        ("a.mcap.zstd", "unzstd"),
        ("A.bag.GZ", "gunzip"),
    ],
)
def test_what_is_packed_is_refused_with_the_command_that_unpacks_it(tmp_path, name, command):
    (tmp_path / name).write_bytes(b"packed")
    with pytest.raises(ToolError, match=f"{name}: is packed: unpack it with '{command} /.*{name}'"):
        open_recording(tmp_path / name, ReadingOptions())


def test_larger_scans_are_thinned_to_what_a_server_takes_and_it_is_told_once(tmp_path, capsys):
    cloud = np.random.default_rng(0).uniform(1, 2, (500, 3)).astype(np.float32)
    write_folder(tmp_path, [cloud[:90], cloud, cloud], np.tile(np.eye(4), (3, 1, 1)), [1, 2, 3])
    parser = ArgumentParser()
    add_recording(parser)
    counts = [
        len(scan.points) for scan in open_selected(parser.parse_args([str(tmp_path)]), 100).scans()
    ]
    assert counts == [90, 100, 100]
    told = capsys.readouterr().err
    assert told.count("scans of more than 100 points, such as one of 500, are thinned to") == 1


def test_a_full_disk_is_called_that():
    assert why(OSError(errno.ENOSPC, "No space left")).startswith("the disk is full (")
    assert why(PermissionError(errno.EACCES, "denied")) == "[Errno 13] denied"
