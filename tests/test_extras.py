"""Optional libraries: each is an extra that is named where it is missing, and none is imported before it is used."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

from omniperception.common.figures import PlotsUnavailable, new_figure
from omniperception.lidar import TriangleMesh, mid360

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMPORT_NAMES = {
    "hydra-core": "hydra",
    "mujoco-core": "mujoco",
    "pyyaml": "yaml",
    "rsl-rl-lib": "rsl_rl",
    "warp-lang": "warp",
}
CODE = [*ROOT.glob("omniperception/**/*.py"), *ROOT.glob("scripts/*.py"), ROOT / "train.py", ROOT / "play.py"]


@pytest.mark.parametrize(
    ("modules", "use", "extra"),
    [
        (("trimesh",), lambda: TriangleMesh.from_file("rock.stl"), "meshes"),
        (("mujoco_lidar",), lambda: mid360("table"), "tables"),
        (("matplotlib", "matplotlib.figure"), lambda: new_figure(1.0, 1.0), "plots"),
    ],
)
def test_a_missing_library_names_its_extra(monkeypatch, modules, use, extra):
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"pip install 'omniperception\[{extra}\]'") as error:
        use()
    assert "\n" not in str(error.value)
    assert extra != "plots" or isinstance(error.value, PlotsUnavailable)


def test_every_extra_that_is_named_exists():
    texts = [path.read_text() for path in (*CODE, ROOT / "README.md")]
    named = {extra for text in texts for extra in re.findall(r"omniperception\[(\w+)\]", text)}
    assert {"meshes", "tables", "plots", "gpu"} <= named <= set(PROJECT["optional-dependencies"])


def test_only_dependencies_are_imported_before_they_are_used():
    names = (re.match(r"[\w-]+", requirement).group() for requirement in PROJECT["dependencies"])
    allowed = {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names} | {"omniperception", "benchmarks"}
    for path in CODE:
        for name in module_level_imports(ast.parse(path.read_text())):
            assert name in allowed or name in sys.stdlib_module_names, f"{path}: {name}"


def module_level_imports(tree):
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module.split(".")[0]
