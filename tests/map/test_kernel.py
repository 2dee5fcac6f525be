"""Compiled code is kept between processes, and made again when anything changes that it uses."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
import triquad_format
import triquad_map
import triquad_server
import triquad_tools
from triquad_map.compiled import kernel

CALLER = """
from triquad_map.compiled.kernel import kernel
from triquad_map.surface import ADDED
from triquad_server.callee import callee

@kernel()
def caller(x):
    return 10 * callee(x) + ADDED

print(caller(2), sum(caller.stats.cache_hits.values()))
"""

CALLEE = """
from triquad_map.compiled.kernel import kernel

@kernel()
def callee(x):
    return x + 1
"""

ON_A_FULL_DISK = """
import shutil, types

shutil.disk_usage = lambda _: types.SimpleNamespace(free=1000)
"""


@pytest.fixture
def source(tmp_path):
    """Packages of a few kernels, below those of the folder's cache."""
    source = tmp_path / "source"
    sources = {
        "triquad_map/__init__": "",
        "triquad_map/compiled/__init__": "",
        "triquad_map/compiled/kernel": Path(kernel.__file__).read_text(),
        "triquad_map/surface": "ADDED = 3",
        "triquad_server/__init__": "",
        "triquad_server/caller": CALLER,
        "triquad_server/callee": CALLEE,
    }
    for name, text in sources.items():
        file = source / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return source


def run(source, **variables):
    """The result of the caller in a process of its own, and what it found compiled."""
    result, found = run_process(source, **variables).stdout.split()
    return int(result), int(found)


def run_process(source, before="", **variables):
    unset = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    environment["HOME"] = str(source.parent / "home")
    code = f"import sys; sys.path.insert(0, {str(source)!r}); import triquad_server.caller"
    return subprocess.run(
        [sys.executable, "-c", before + code],
        env=environment | variables,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )


def edit(source, module, old, new):
    file = source / f"{module}.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def test_compiled_code_is_found_by_the_next_process_and_removed_when_what_it_uses_changed(source):
    assert run(source) == (33, 0)
    assert run(source) == (33, 1)
    edit(source, "triquad_server/callee", "x + 1", "x + 2")
    assert run(source) == (43, 0)
    edit(source, "triquad_map/surface", "3", "4")
    assert run(source) == (44, 0)
    (installation,) = (source.parent / "home" / ".cache" / "triquad" / "kernels").iterdir()
    assert len(list(installation.iterdir())) == 1


def test_the_folder_that_the_user_chose_is_used(source, tmp_path):
    chosen = tmp_path / "chosen"
    run(source, NUMBA_CACHE_DIR=str(chosen))
    assert any(chosen.rglob("*.nbc"))
    assert not (tmp_path / "home").exists()


def test_without_a_home_code_is_kept_in_a_temporary_folder(source, tmp_path):
    (tmp_path / "home").write_text("no folder")
    (tmp_path / "temporary").mkdir()
    for found in (0, 1):
        assert run(source, TMPDIR=str(tmp_path / "temporary")) == (33, found)


def test_a_temporary_folder_of_others_is_not_trusted(source, tmp_path):
    (tmp_path / "home").write_text("no folder")
    planted = tmp_path / "temporary" / f"triquad-kernels-{os.getuid()}"
    planted.mkdir(parents=True)
    planted.chmod(0o777)
    process = run_process(source, TMPDIR=str(tmp_path / "temporary"))
    assert process.stdout.split() == ["33", "0"]
    assert "set NUMBA_CACHE_DIR" in process.stderr
    assert list(planted.iterdir()) == []


def test_on_a_full_disk_kernels_run_and_what_was_kept_before_is_found(source):
    process = run_process(source, before=ON_A_FULL_DISK)
    assert process.stdout.split() == ["33", "0"]
    assert "nearly full" in process.stderr
    assert run(source) == (33, 0)
    assert run_process(source, before=ON_A_FULL_DISK).stdout.split() == ["33", "1"]


PACKAGES = (triquad_format, triquad_map, triquad_server, triquad_tools)
MODULES = {
    ".".join(file.relative_to(root.parent).with_suffix("").parts): file
    for root in (Path(str(package.__file__)).parent for package in PACKAGES)
    for file in root.rglob("*.py")
}
WITH_KERNELS = [
    name
    for name, file in MODULES.items()
    if any(decorator in file.read_text() for decorator in ("@kernel", "@inner_kernel"))
]


def is_kernel(statement):
    decorators = getattr(statement, "decorator_list", ())
    return any("kernel" in ast.unparse(decorator) for decorator in decorators)


def imported_names(tree):
    """From which module of these packages each name is, that a module imports."""
    return {
        alias.asname or alias.name: whole
        if (whole := f"{node.module}.{alias.name}") in MODULES
        else node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("triquad_")
        for alias in node.names
    }


def names_in(*parts, kind=ast.expr_context):
    names = (node for part in parts for node in ast.walk(part) if isinstance(node, ast.Name))
    return {name.id for name in names if isinstance(name.ctx, kind)}


def names_from_outside(function):
    """Names that the body of a function uses, and that are neither arguments nor assigned there."""
    own = names_in(*function.body, kind=ast.Store) | {each.arg for each in function.args.args}
    return names_in(*function.body, kind=ast.Load) - own


@pytest.mark.parametrize("module", WITH_KERNELS)
def test_kernels_take_constants_from_files_that_are_in_the_digest_alone(module):
    """Else compiled code would stay as it is when they change."""
    tree = ast.parse(MODULES[module].read_text())
    kernels = [statement for statement in tree.body if is_kernel(statement)]
    assigned = [part for part in tree.body if isinstance(part, (ast.Assign, ast.AnnAssign))]
    used = {name for function in kernels for name in names_from_outside(function)}
    used |= names_in(*(part.value for part in assigned if names_in(part) & used and part.value))
    for name, origin in imported_names(tree).items():
        if name in used and origin not in WITH_KERNELS:
            assert origin.replace(".", "/").startswith(
                tuple(place.removesuffix(".py") for place in kernel._CONSTANTS)
            ), f"{name} of {origin}: add this file to _CONSTANTS of compiled/kernel.py"
