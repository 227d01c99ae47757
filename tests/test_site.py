"""The docs site: every page and module that it names exists, every page is in it, links out of docs/ are replaced, the
picture of the packages is that of the sources."""

import re
import sys
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "tools"))
import draw_packages
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
        paths = [ROOT / top / name.replace(".", "/") for top in ("", "packages/lidar", "packages/robot")]
        assert any(path.with_suffix(".py").is_file() or (path / "__init__.py").is_file() for path in paths), name


def test_links_that_leave_the_docs_lead_to_the_repository():
    text = "[a](../../tests/x.py) [b](../lab/y.md) [c](z.md#d) ![e](../view.png) [`f`](../../README.md)"
    assert outward(text, "guide/p.md", None) == "a [b](../lab/y.md) [c](z.md#d) ![e](../view.png) `f`"
    there = outward(text, "guide/p.md", "https://example.org/o/r/")
    assert "[a](https://example.org/o/r/blob/main/tests/x.py)" in there and "[b](../lab/y.md)" in there
    assert outward("[r](../README.md)", "index.md", None) == "r"


def test_the_picture_of_the_packages_is_that_of_the_sources():
    names = draw_packages.packages()
    assert set(names) == set(draw_packages.ROLES), "correct ROLES in docs/tools/draw_packages.py"
    drawn = draw_packages.picture(draw_packages.imports(), names)
    assert drawn == draw_packages.PICTURE.read_text(), "python docs/tools/draw_packages.py draws it again"


def test_imports_of_packages_are_found_and_ordered(tmp_path):
    root = tmp_path / "tree"
    sources = {
        "__init__.py": "from tree import top",
        "top.py": "import tree.middle.parts\nfrom tree.bottom import a",
        "middle/__init__.py": "from . import parts",
        "middle/parts.py": "from tree import bottom\nfrom ..bottom import b\nimport os",
        "bottom/__init__.py": "def late():\n    from tree.middle import parts",
        "notes/read.txt": "import tree.top",
    }
    for name, text in sources.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    assert draw_packages.packages(root) == ["bottom", "middle", "top"]
    found = draw_packages.imports(root)
    assert found == {("top", "middle"): 1, ("top", "bottom"): 1, ("middle", "bottom"): 2, ("bottom", "middle"): 1}
    back = draw_packages.against_the_order(found)
    assert back == {("bottom", "middle")}
    assert draw_packages.shown(set(found) - back) == {("top", "middle"), ("middle", "bottom")}
    assert draw_packages.rows(set(found) - back, ["bottom", "middle", "top"]) == [["top"], ["middle"], ["bottom"]]
