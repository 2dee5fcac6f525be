"""What the site adds to the pages.

It shows the help of every command and the fields of every dataclass, and has the pages of the
repository's root, to which links lead as on GitHub.
"""

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import is_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_DOCS = Path(__file__).parent
_ROOT = _DOCS.parent
_ROOT_PAGES = {
    "project/changes": "CHANGELOG.md",
    "project/contributing": "CONTRIBUTING.md",
    "project/security-policy": "SECURITY.md",
}
_LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")
_COLUMNS = "100"
_COMMENT = re.compile(r"(?:^|  )# (.+)")


def setup(app: Sphinx) -> dict[str, Any]:
    """Take part in the build."""
    app.connect("source-read", _fill_page)
    app.add_directive("command-help", CommandHelp)
    app.connect("autodoc-process-docstring", _add_fields)
    app.connect("autodoc-skip-member", _skip_constants)
    return {"parallel_read_safe": True}


def _fill_page(_app: Sphinx, page: str, source: list[str]) -> None:
    """Take what GitHub shows, with links to where the site has that; to a folder it has none."""
    folder = written_in = (_DOCS / page).parent
    if page in _ROOT_PAGES:
        source[0], written_in = (_ROOT / _ROOT_PAGES[page]).read_text(encoding="utf-8"), _ROOT
    elsewhere = {_ROOT / name: _DOCS / f"{page}.md" for page, name in _ROOT_PAGES.items()}
    elsewhere[_ROOT / "README.md"] = _DOCS / "index.md"

    def led(link: re.Match[str]) -> str:
        text, name, anchor = link[1], link[2], link[3] or ""
        target = (written_in / name).resolve()
        if target.is_dir():
            return text
        return f"[{text}]({os.path.relpath(elsewhere.get(target, target), folder)}{anchor})"

    source[0] = _LINK.sub(led, source[0])


class CommandHelp(SphinxDirective):
    """A section for each installed command of triquad, with what its ``--help`` prints."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        scripts = entry_points(group="console_scripts")
        commands = sorted({one.name for one in scripts if one.value.startswith("triquad_")})
        with ThreadPoolExecutor() as running:
            return list(running.map(_section, commands))


def _section(command: str) -> nodes.section:
    section = nodes.section(ids=[command], names=[command])
    section += nodes.title(command, command)
    texts = [_help(command)]
    parts = re.findall(rf"{command} (\w+) --help", texts[0])
    if "COMMAND" in texts[0]:
        parts += re.findall(r"^    (\w+) +\S", texts[0], re.MULTILINE)
    texts += [_help(command, part) for part in parts]
    section += [nodes.literal_block(text, text, language="none") for text in texts]
    return section


def _help(command: str, *part: str) -> str:
    program = Path(sys.executable).with_name(command)
    settings = {**os.environ, "COLUMNS": _COLUMNS, "NO_COLOR": "1"}
    asked = [str(program), *part, "--help"]
    done = subprocess.run(asked, env=settings, check=True, capture_output=True, text=True)
    return done.stdout


def _skip_constants(
    _app: Sphinx, what: str, _name: str, member: object, _skip: bool, _options: object
) -> bool | None:
    return True if what == "module" and not isinstance(member, type) else None


def _add_fields(
    _app: Sphinx, what: str, _name: str, made: Any, _options: object, lines: list[str]
) -> None:
    """Append a dataclass's fields to its docstring, as the comments in its source tell them."""
    if what == "class" and isinstance(made, type) and is_dataclass(made):
        lines += ["", *_fields(made), ""]


def _fields(made: type) -> Iterator[str]:
    source = textwrap.dedent(inspect.getsource(made))
    written = source.splitlines()
    (node,) = ast.parse(source).body
    assert isinstance(node, ast.ClassDef)
    for part, following in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(part, ast.AnnAssign) or part.end_lineno is None:
            continue
        if isinstance(following, ast.Expr):  # a docstring, which autodoc itself shows
            continue
        told = _COMMENT.search(written[part.end_lineno - 1])
        comment = [told[1]] if told else []
        above = part.lineno - 2
        while written[above].lstrip().startswith("# "):
            comment.insert(0, written[above].strip().removeprefix("# "))
            above -= 1
        name, kind = ast.unparse(part.target), part.annotation
        if isinstance(kind, ast.Subscript) and ast.unparse(kind.value) == "Annotated":
            kind = kind.slice.elts[0] if isinstance(kind.slice, ast.Tuple) else kind.slice
        yield f":ivar {name}: {_escaped(' '.join(comment))}"
        yield f":vartype {name}: ``{ast.unparse(kind)}``"


def _escaped(comment: str) -> str:
    return re.sub(r"([*|\\`]|_\b)", r"\\\1", comment)
