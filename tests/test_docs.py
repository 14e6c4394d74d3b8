"""The pages name what exists: code, files, commands and links."""

from __future__ import annotations

import importlib
import json
import re
from itertools import product
from pathlib import Path

import pytest
import yaml

from refu_core.garments import BUILTIN_GARMENTS, load_garment
from refu_core.recordings._upright import PELVIS, PELVIS_OF_SMPLX
from refu_core.skeleton import JOINT_NAMES
from refu_core.weights import weights_folder

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


MOTION_ROWS = {
    "collision-free frames, against the collider": "cfmp_percent",
    "vertices inside the collider": "vfcp_percent",
    "collision-free frames, against the unmodified skin": "skin_cfmp_percent",
    "frame pairs, 1/60 s apart, in which a vertex moves more than 20 mm relative": "jump_20_percent",
    "… by more than 40 mm": "jump_40_percent",
    "… in which a vertex moves 20 mm farther than it does in the skinned garment": "leap_20_percent",
    "edges longer than twice their rest length": "stretched_percent",
}
"""How the README's rows of recorded motion begin, and what they show."""
PART_ROWS = {
    "network alone": "tailornet",
    "plus the paper's layer": "refu-hybrid-bare",
    "plus a margin": "refu-hybrid-unblended",
    "plus blending": "refu-hybrid",
    "the node: all of these": "node-hybrid",
}


def readme_cells(row: str) -> list[str]:
    """The cells of the README's one row that begins like this, without the first."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith(f"| {row}"))
    return [cell.strip() for cell in line.strip("|").split("|")[1:]]


def results(table: str) -> dict[tuple[str, str, str], float]:
    """Figures by garment, method and metric."""
    rows = json.loads((DOCS / "results" / f"{table}.json").read_text(encoding="utf-8"))["rows"]
    return {(row["garment"], row["method"], row["metric"]): row["value"] for row in rows}


def says(cell: str, value: float) -> bool:
    """Whether a cell shows the value, rounded to its own digits; "100" and "none" say all and none."""
    if cell == "none":
        return value == 0
    number = cell.split()[-2] if cell.endswith(("%", "mm")) else cell
    if cell.startswith("<"):
        return 0 < value < float(number)
    is_rounded = f"{value:.{len(number.partition('.')[2])}f}" == number
    return is_rounded and (float(number) != 100 or value == 100)


def test_the_readme_shows_the_results() -> None:
    motion, parts, wrong = results("motion"), results("parts"), []
    garments = "tshirt-male", "shirt-male", "short-pant-male", "skirt-female"
    for row, metric in MOTION_ROWS.items():
        cells = readme_cells(row)
        assert len(cells) == len(garments)
        for garment, cell in zip(garments, cells, strict=True):
            value = motion[f"{garment}, all clips", "node-hybrid", metric]
            wrong += [(row, garment, cell, value)] if not says(cell, value) else []
    for row, method in PART_ROWS.items():
        for cell, metric in zip(readme_cells(row), ("mpve_mm", "vfcp_percent", "cfmp_percent"), strict=True):
            value = parts["all", method, metric]
            wrong += [(row, metric, cell, value)] if not says(cell, value) else []
    assert wrong == []


def test_the_node_s_page_names_the_joints_in_their_order() -> None:
    (listed,) = re.findall(
        r"^The joints, in SMPL's order, are (.*?)\. So", (DOCS / "guide/ros.md").read_text(), re.S | re.M
    )
    assert tuple(re.findall(r"`(\w+)`", listed)) == JOINT_NAMES


def test_the_node_s_page_moves_smplx_as_files_are_moved() -> None:
    text = (DOCS / "guide" / "ros.md").read_text(encoding="utf-8")
    shift = ", ".join(f"{number:.3f}" for number in PELVIS_OF_SMPLX - PELVIS)
    assert f"add ({shift}) m to its translation" in text


def test_the_garments_page_says_what_ships() -> None:
    """Which garments there are, in how many styles, and which of them swing."""
    text = (DOCS / "guide/garments.md").read_text(encoding="utf-8")
    said = {}
    for row in re.findall(r"^\| (`[a-z-]+`.*`-\w+`.*) \|$", text, flags=re.MULTILINE):
        names, *bodies, styles, swings, _ = row.split("|")
        for name, body in product(re.findall(r"`(.*?)`", names), re.findall(r"`(.*?)`", "".join(bodies))):
            said[name + body] = styles.strip() == "four", swings.strip() == "yes"
    assert said == {
        name: (load_garment(name).styledirs is not None, (weights_folder(name) / "dynamics.json").exists())
        for name in BUILTIN_GARMENTS
    }


def test_pages_install_what_their_commands_need() -> None:
    """Several processes are run by the extra `cluster`."""
    for page in PAGES:
        for block in re.findall(r"^```bash\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.S | re.M):
            assert "pip install" not in block or "--jobs" not in block or "cluster" in block, page


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
