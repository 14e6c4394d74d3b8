"""Puts the tables that `refu benchmark` wrote last into docs/performance.md, where `<!-- table: TITLE -->` stands.

python benchmarks/page.py [--check]
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/performance.md"
RESULTS = ROOT / "docs/results/performance.md"
_PLACE = re.compile(r"(<!-- table: (?P<title>.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str, results: str) -> str:
    """The page with the sections of the results in their places. Raises `KeyError` for one that isn't there."""
    head, *parts = re.split(r"^## ", results, flags=re.MULTILINE)
    sections = dict(part.split("\n", 1) for part in parts)
    # The first paragraph after the title says what was run, on what.
    sections["Conditions"] = head.split("\n\n")[1]
    return _PLACE.sub(lambda place: f"{place[1]}{sections[place['title']].strip()}\n{place[3]}", page)


def main() -> int:
    """Writes the page, or says whether it is up to date."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 where the page is out of date")
    check = parser.parse_args().check
    before = PAGE.read_text(encoding="utf-8")
    after = filled(before, RESULTS.read_text(encoding="utf-8"))
    if not check:
        PAGE.write_text(after, encoding="utf-8")
    return int(check and before != after)


if __name__ == "__main__":
    sys.exit(main())
