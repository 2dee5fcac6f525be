"""What docstrings, comments and pages refer to is there."""

import ast
import json
import re
import runpy
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from triquad_server.monitoring.prometheus import FAMILIES

from bench.paper.__main__ import PICTURES, WORLDS

ROOT = Path(__file__).parents[3]
PACKAGES = ("format", "map", "client", "server", "tools")
SOURCES = [
    (ROOT / package, path) for package in PACKAGES for path in (ROOT / package).rglob("*.py")
]
IN_FULL = re.compile(r"\btriquad_(?:format|map|client|server|tools)(?:\.\w+)+")
LINK = re.compile(r"\]\(([^)\s]+)\)")
BY_ROLE = re.compile(r":(?:mod|func|class|meth|attr|data|exc):`~?([^`]*)`")


def defined_in(body: Iterable[ast.stmt]) -> Iterator[str]:
    """The names that a module or a class has, and those of what its classes have."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)
        if isinstance(node, ast.ClassDef):
            yield from (f"{node.name}.{name}" for name in defined_in(node.body))


@pytest.fixture(scope="module")
def known() -> set[str]:
    """All modules, and what they define: by the name in full, and by each of its parts."""
    names = set()
    for package, path in SOURCES:
        module = ".".join(path.relative_to(package).with_suffix("").parts)
        module = module.removesuffix(".__init__")
        names.add(module)
        for name in defined_in(ast.parse(path.read_text()).body):
            names |= {f"{module}.{name}", *name.split(".")}
    return names


def test_names_in_full_are_there(known: set[str]) -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    texts = {path: path.read_text() for path in [*pages, *(path for _, path in SOURCES)]}
    used = {(path, name) for path, text in texts.items() for name in IN_FULL.findall(text)}
    assert len(used) > 1000
    assert {(path, name) for path, name in used if name not in known} == set()


def test_docstrings_refer_to_what_there_is(known: set[str]) -> None:
    used = {(path, name) for _, path in SOURCES for name in BY_ROLE.findall(path.read_text())}
    assert len(used) > 100
    missing = {
        (path, name)
        for path, name in used
        if name not in known and not known.issuperset(name.split("."))
    }
    assert missing == set()


def anchors(page: str) -> set[str]:
    """What links name the headings of a page by."""
    headings = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    words = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", word).replace(" ", "-") for word in words}


def test_links_lead_to_pages_and_headings_that_there_are() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    links = [(page, link) for page in pages for link in LINK.findall(page.read_text())]
    lost = []
    for page, link in links:
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if "://" in link or (target.exists() and not anchor):
            continue
        if not target.exists() or anchor not in anchors(target.read_text()):
            lost.append((page.name, link))
    assert len(links) > 100
    assert lost == []


def test_every_picture_is_made_by_make_pictures_and_shown_on_a_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    docs = ROOT / "docs"
    monkeypatch.syspath_prepend(str(docs))
    pages = [ROOT / "README.md", *docs.rglob("*.md")]
    made = set()
    for program in ("pictures.py", "viewer_pictures.py", "top_picture.py"):
        assert f"docs/{program}" in (ROOT / "Makefile").read_text()
        names = runpy.run_path(str(docs / program))
        made |= {*names["PICTURES"]} if "PICTURES" in names else {names["PICTURE"].name}
    made |= {f"paper-{key}-{name}" for key in WORLDS for name in PICTURES}
    kept = {path.name for path in (docs / "images").iterdir()}
    shown = {
        name for page in pages for name in re.findall(r"images/([\w-]+\.\w+)\)", page.read_text())
    }
    assert made == kept == shown


def test_the_dashboard_shows_metrics_and_labels_that_there_are() -> None:
    file = ROOT / "docs" / "deploy" / "grafana-dashboard.json"
    dashboard = json.loads(file.read_text(encoding="utf-8"))
    panels = [panel for panel in dashboard["panels"] if panel["type"] != "row"]
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])
    labels = {
        name: {*family.labels, "instance", "le"}
        for family in FAMILIES
        for name in (family.name, *(f"{family.name}_{part}" for part in ("bucket", "count", "sum")))
    }
    shown = set()
    for target in (target for panel in panels for target in panel["targets"]):
        names = re.findall(r"triquad_\w+", target["expr"])
        assert names, target
        used = set(re.findall(r'(\w+)!?[=~]+"', target["expr"]))
        used |= set(re.findall(r"{{(\w+)}}", target["legendFormat"]))
        for name in names:
            assert used <= labels[name], (target, name)
        shown |= {re.sub("_(bucket|count|sum)$", "", name) for name in names}
    assert shown == {family.name for family in FAMILIES}
