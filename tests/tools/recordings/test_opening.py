import errno

import pytest
from triquad_tools.console.command import ToolError
from triquad_tools.mapping.output import why
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("a.zip", "unzip"),
        ("a.tar.gz", "tar -xf"),
        ("a.pcd.zst", "unzstd"),
        ("A.bag.GZ", "gunzip"),
    ],
)
def test_what_is_packed_is_refused_with_the_command_that_unpacks_it(tmp_path, name, command):
    (tmp_path / name).write_bytes(b"packed")
    with pytest.raises(ToolError, match=f"{name}: is packed: unpack it with '{command} /.*{name}'"):
        open_recording(tmp_path / name, ReadingOptions())


def test_a_full_disk_is_called_that():
    assert why(OSError(errno.ENOSPC, "No space left")).startswith("the disk is full (")
    assert why(PermissionError(errno.EACCES, "denied")) == "[Errno 13] denied"
