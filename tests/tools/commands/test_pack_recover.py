"""What is intact of a damaged file, saved by ``triquad-pack --recover``."""

import dataclasses

from support.files.file_damage import first_chunk, flipped
from support.files.mapfile_edit import file_bytes
from support.maps.map_records import SMALL, assert_same, random_record
from triquad_format.mapfile.parts.part import VERTICES
from triquad_format.mapfile.reader import read_map
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.recovered_map import recover

SQUARES = dataclasses.replace(SMALL, depth=9)
RECORD = random_record(5, settings=SQUARES, indices=((0, 0, 0), (1, 0, 0)), points=600)
DATA = file_bytes(RECORD, preview=True, stamp_ns=10**18)


def test_recovery_tells_what_it_saved_and_lost(tmp_path, capsys):
    broken, out = tmp_path / "broken.triquad", tmp_path / "out.triquad"
    broken.write_bytes(DATA[:-100])
    assert main([str(broken), str(out)]) == 1
    assert "triquad-pack --recover" in capsys.readouterr().err
    assert not out.exists()
    assert main(["--recover", str(broken), str(out)]) == 0
    assert "saved all" in capsys.readouterr().out
    assert_same(read_map(out), RECORD)
    broken.write_bytes(flipped(DATA, first_chunk(DATA, VERTICES).middle))
    assert main(["--recover", "--force", str(broken), str(out)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("lost: training state of region 0 0 0")
    assert lines[1] == (
        "lost: vertices of plane XY of region 0 0 0: now UNKNOWN, "
        "x -65.0 to 0.5 m, y -65.0 to 0.5 m, z -64.5 to 64.5 m"
    )
    assert lines[2].startswith("saved ")
    assert_same(read_map(out), recover(broken).record)
    before = out.read_bytes()
    broken.write_bytes(DATA[:100])
    assert main(["--recover", "--force", str(broken), str(out)]) == 2
    assert "nothing can be saved" in capsys.readouterr().err
    assert out.read_bytes() == before
