import re
import subprocess
import sys
from pathlib import Path

from triquad_tools.map_mutations import MUTATIONS

GOLDEN = Path(__file__).parent / "golden"


def fuzz(*arguments):
    """Run the command in a process of its own: it limits its memory; of time it may take any."""
    command = [sys.executable, "-m", "triquad_tools.fuzz_maps", "--limit", "0", *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_readers_mind_two_thousand_spoilt_files():
    run = fuzz(
        "--count",
        "2000",
        *(str(GOLDEN / f"map_{kind}.triquad") for kind in ("v1", "v1_next", "v1_levels")),
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "2000 files, each read in two ways" in run.stdout
    rows = [line for line in run.stdout.splitlines() if line.startswith(tuple(MUTATIONS))]
    assert len(rows) == len(MUTATIONS)
    for row in rows:
        counts = [int(number) for number in re.findall(r"\d+", row)]
        assert sum(counts[:-2]) > 0, row


def outcomes(*arguments):
    """The table for five files, without times and memory."""
    lines = fuzz("--count", "5", *arguments).stdout.splitlines()
    return [re.sub(r" +\d+ ms.*", "", line) for line in lines[:-1]]


def test_each_file_can_be_made_again():
    assert outcomes("--first", "70") == outcomes("--first", "70")
    assert outcomes("--first", "70") != outcomes("--first", "170")
    assert outcomes("--first", "70") != outcomes("--first", "70", "--seed", "1")


def test_a_reader_that_believes_what_it_reads_is_found(tmp_path):
    """The command itself must be able to fail."""
    script = tmp_path / "credulous.py"
    script.write_text(
        "import sys\n"
        "from triquad_format.manifest import Entry\n"
        "from triquad_tools import fuzz_maps\n"
        "Entry.check = lambda *_: None\n"
        "sys.exit(fuzz_maps.main(['--count', '500', '--limit', '0']))\n"
    )
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert run.returncode == 1
    assert re.search(r"another map.*; again: --seed 0 --first \d+ --count 1", run.stdout)
