"""The docs site: every page and module that it names exists, every page is in it, links out of docs/ are replaced."""

import re
import sys
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
from hooks import outward

ROOT = Path(__file__).resolve().parents[1]


def pages(nav):
    """Paths of all pages in a navigation."""
    for entry in nav:
        (value,) = entry.values()
        yield from pages(value) if isinstance(value, list) else [value]


def test_the_navigation_has_every_page_once():
    named = list(pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]))
    existing = sorted(str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md"))
    assert sorted(named) == existing


def test_modules_of_the_reference_exist():
    found = {
        name for page in (ROOT / "docs" / "api").glob("*.md") for name in re.findall(r"(?m)^::: (.+)", page.read_text())
    }
    assert len(found) > 40
    for name in found:
        path = ROOT / name.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__init__.py").is_file(), name


def test_links_that_leave_the_docs_lead_to_the_repository():
    text = "[a](../../tests/x.py) [b](../lab/y.md) [c](z.md#d) ![e](../view.png) [`f`](../../README.md)"
    assert outward(text, "guide/p.md", None) == "a [b](../lab/y.md) [c](z.md#d) ![e](../view.png) `f`"
    there = outward(text, "guide/p.md", "https://example.org/o/r/")
    assert "[a](https://example.org/o/r/blob/main/tests/x.py)" in there and "[b](../lab/y.md)" in there
    assert outward("[r](../README.md)", "index.md", None) == "r"
