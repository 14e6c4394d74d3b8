"""The pages name what exists: code, files, commands and links."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), *ROOT.glob("*.md")])
CODE = [path for name in ("refu_core", "msg_adapters", "refu_ros", "refu_lab") for path in (ROOT / name).rglob("*.py")]


def places() -> list[str]:
    """Each `file:name` of the architecture page."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    return sorted(set(re.findall(r"`([\w/]+\.py:[\w.]+)`", text)))


@pytest.mark.parametrize("place", places())
def test_the_paper_is_where_the_page_says(place: str) -> None:
    path, name = place.split(":")
    found = importlib.import_module(path.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        found = getattr(found, part)


def test_every_equation_of_the_paper_has_a_place() -> None:
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    table = re.search(r"<!-- paper -->(.*)<!-- end -->", text, flags=re.DOTALL)
    assert table is not None
    listed: set[int] = set()
    for cell in re.findall(r"^\| (\([^|]*) \|", table[1], flags=re.MULTILINE):
        for first, last in re.findall(r"\((\d+)\)(?:–\((\d+)\))?", cell):
            listed |= set(range(int(first), int(last or first) + 1))
    assert listed == set(range(1, 19))


def headings(path: Path) -> set[str]:
    """The anchors of a page, as GitHub and mkdocs make them."""
    lines = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).strip().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), target
        assert not anchor or anchor in headings(path), target


def test_named_files_exist() -> None:
    pages = [page for page in PAGES if page.name != "CHANGELOG.md"]  # it tells of files that were
    folders = "docs|tests|examples|scripts|benchmarks|config|refu_\\w+|msg_adapters"
    place = rf"(?<![\w/.-])((?:{folders})/[\w/.-]+\.\w+)"
    named = {(path, name) for path in (*pages, *CODE) for name in re.findall(place, path.read_text(encoding="utf-8"))}
    assert len(named) > 100
    assert [f"{path}: {name}" for path, name in sorted(named) if not (ROOT / name).exists()] == []


def test_navigation_names_every_page() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def files(node: object) -> list[str]:
        if isinstance(node, str):
            return [node]
        parts = node.values() if isinstance(node, dict) else node
        return [path for part in parts for path in files(part)]

    listed = files(config["nav"])
    assert len(listed) == len(set(listed))
    assert set(listed) == {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}


def test_reference_pages_name_modules() -> None:
    named = [
        name
        for page in (DOCS / "api").glob("*.md")
        for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    ]
    assert {"refu_core.realtime", "refu_core.sdf", "msg_adapters"} <= set(named)
    for name in named:
        importlib.import_module(name)
