"""Compiled code is kept between processes, and made anew when anything changes that it uses."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

CALLER = """
from triquad_map.compiled.kernel import kernel
from triquad_toy.callee import callee
from triquad_toy.constants import ADDED

@kernel()
def caller(x):
    return 10 * callee(x) + ADDED

print(caller(2), sum(caller.stats.cache_hits.values()))
"""

ON_A_FULL_DISK = """
import resource, signal, sys

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))
"""

CALLEE = """
from triquad_map.compiled.kernel import kernel

@kernel()
def callee(x):
    return x + 1
"""


AFTER_PACKING = """
import triquad_toy.callee
from triquad_map.compiled.bitcode import pack_bitcode

assert triquad_toy.callee.callee(1) == 2  # found compiled
pack_bitcode()
"""


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "source" / "triquad_toy"
    folder.mkdir(parents=True)
    sources = {"__init__": "", "caller": CALLER, "callee": CALLEE, "constants": "ADDED = 3"}
    for name, source in sources.items():
        (folder / f"{name}.py").write_text(source)
    return folder


def run(package, **variables):
    """The result of the caller in a process of its own, and what it found compiled."""
    result, found = run_process(package, **variables).stdout.split()
    return int(result), int(found)


def run_process(package, before="", **variables):
    unset = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    environment["HOME"] = str(package.parents[1] / "home")
    code = f"import sys; sys.path.append({str(package.parent)!r}); import triquad_toy.caller"
    return subprocess.run(
        [sys.executable, "-c", before + code],
        env=environment | variables,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )


def edit(package, module, old, new):
    file = package / f"{module}.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def test_compiled_code_is_found_by_the_next_process(package):
    assert run(package) == (33, 0)
    assert run(package) == (33, 1)


def test_a_kernel_is_compiled_that_calls_one_whose_bitcode_was_packed(package):
    run(package)
    edit(package, "caller", "10 * callee(x)", "100 * callee(x)")  # is compiled anew, callee is not
    edit(package, "caller", "from triquad_toy.callee", AFTER_PACKING + "from triquad_toy.callee")
    assert run(package) == (303, 0)


def test_who_waits_while_it_is_compiled_is_told_once(package):
    assert run_process(package).stderr.count("compiling") == 1
    assert run_process(package).stderr == ""


def test_of_several_processes_one_compiles_each_kernel(package):
    with ThreadPoolExecutor() as pool:
        runs = [pool.submit(run_process, package) for _ in range(3)]
        results = [run.result().stdout.split() for run in runs]
    assert sorted(results) == [["33", "0"], ["33", "1"], ["33", "1"]]


def test_a_change_of_what_a_kernel_calls_counts(package):
    run(package)
    edit(package, "callee", "x + 1", "x + 2")
    assert run(package) == (43, 0)


def test_a_change_of_a_constant_of_another_module_counts(package):
    run(package)
    edit(package, "constants", "3", "4")
    assert run(package) == (34, 0)


def test_code_of_earlier_sources_is_removed(package):
    run(package)
    edit(package, "callee", "x + 1", "x + 2")
    run(package)
    kernels = package.parents[1] / "home" / ".cache" / "triquad" / "kernels"
    digests = {folder.name: len(list(folder.iterdir())) for folder in kernels.iterdir()}
    assert len(digests) == 2
    assert set(digests.values()) == {1}


def test_the_folder_that_the_user_chose_is_used(package, tmp_path):
    chosen = tmp_path / "chosen"
    run(package, NUMBA_CACHE_DIR=str(chosen))
    assert any(chosen.rglob("*.nbc"))
    assert not (tmp_path / "home").exists()


def test_without_a_home_code_is_kept_in_a_temporary_folder(package, tmp_path):
    (tmp_path / "home").write_text("no folder")
    (tmp_path / "temporary").mkdir()
    for found in (0, 1):
        assert run(package, TMPDIR=str(tmp_path / "temporary")) == (33, found)


def test_a_temporary_folder_of_others_is_not_trusted(package, tmp_path):
    (tmp_path / "home").write_text("no folder")
    planted = tmp_path / "temporary" / f"triquad-kernels-{os.getuid()}"
    planted.mkdir(parents=True)
    planted.chmod(0o777)
    for _ in range(2):
        assert run(package, TMPDIR=str(tmp_path / "temporary")) == (33, 0)
    assert list(planted.iterdir()) == []


def test_a_full_disk_keeps_no_kernel_from_running(package):
    process = run_process(package, before=ON_A_FULL_DISK)
    assert process.stdout.split() == ["33", "0"]
    assert "cannot be kept: [Errno 27] File too large" in process.stderr
    assert run(package) == (33, 0)
    assert run(package) == (33, 1)


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0, 100])
def test_compiled_code_that_is_damaged_is_made_anew(package, suffix, left):
    run(package)
    kernels = package.parents[1] / "home" / ".cache" / "triquad" / "kernels"
    for file in kernels.rglob(f"*.{suffix}"):
        file.write_bytes(file.read_bytes()[:left])
    process = run_process(package)
    assert process.stdout.split() == ["33", "0"]
    assert "damaged" in process.stderr
    assert run(package) == (33, 1)
