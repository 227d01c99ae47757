"""What pip installs: the LiDAR toolkit by itself, the extras, the console command with its presets."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from omnilidar import TriangleMesh, mid360
from omniperception.commands import COMMANDS, main
from omniperception.commands import EXTRAS as EXTRA_OF
from omnirobot.common.figures import PlotsUnavailable, new_figure

ROOT = Path(__file__).resolve().parents[1]
PROJECT, LIDAR, ROBOT = (
    tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
    for folder in ("", "packages/lidar", "packages/robot")
)
MODULES = {
    "hydra-core": "hydra",
    "mujoco-core": "mujoco",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "rsl-rl-lib": "rsl_rl",
    "warp-lang": "warp",
}
BLOCK = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
"""
EXTRAS = {
    "hydra",
    "omegaconf",
    "pydantic",
    "yaml",
    "mujoco",
    "rsl_rl",
    "tensordict",
    "tensorboard",
    "matplotlib",
    "trimesh",
}
CAST = """
import sys

import numpy as np
from omnilidar import Lidar, LidarConfig, RayScene, Shape, ShapeKind, vlp16

ball = Shape(ShapeKind.SPHERE, (0.5,), pos=(3.0, 0.0, 1.0))
scene = RayScene([Shape(ShapeKind.PLANE), ball], num_envs=1, num_bodies=0)
hits = scene.cast(np.array([[[0.0, 0.0, 1.0]]]), np.array([[[1.0, 0.0, 0.0]]]), max_range=20.0)
assert abs(float(hits.ranges[0, 0]) - 2.5) < 1e-5
outside = {"omniperception", "omnirobot"} & set(sys.modules)
assert not outside, outside
"""


def python(code, **options):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, **options)


def test_the_toolkit_casts_without_what_training_needs():
    done = python(BLOCK.format(names=EXTRAS) + CAST)
    assert done.returncode == 0 and done.stderr == "", done.stderr


def test_a_command_names_the_extra_that_it_lacks():
    code = BLOCK.format(names={"hydra"}) + "from omniperception.commands import main; main(['train', 'num_envs=2'])"
    done = python(code)
    assert done.returncode == 2
    assert done.stderr == "error: train needs hydra: pip install 'omniperception[train]'\n"


def test_the_console_command_lists_and_explains_all_commands(capsys):
    main(["--help"])
    listed = capsys.readouterr().out
    for name in COMMANDS:
        assert f"\n  {name} " in listed
        main([name, "--help"])
        shown = capsys.readouterr().out
        module = importlib.import_module(main.modules[name])
        assert shown.startswith(f"usage: omniperception {name} ") and module.__doc__.splitlines()[0] in shown
    with pytest.raises(SystemExit, match="2"):
        main(["trian"])
    assert "trian is unknown; known: demo, train, " in capsys.readouterr().err


@pytest.mark.slow
def test_the_wheel_trains_and_plays_in_an_empty_folder(tmp_path):
    source, site, empty = tmp_path / "source", tmp_path / "site", tmp_path / "empty"
    for name in ("omniperception", "conf", "pretrained"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", ".", "-w", str(tmp_path)]
    done = subprocess.run(pip, cwd=source, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(site)
    package = site / "omniperception"
    for top in ("conf", "pretrained"):
        shipped = {path.relative_to(ROOT / top) for path in (ROOT / top).rglob("*") if path.is_file()}
        assert {path.relative_to(package / top) for path in (package / top).rglob("*") if path.is_file()} == shipped
    (entry,) = site.glob("*.dist-info/entry_points.txt")
    assert "omniperception = omniperception.commands:main" in entry.read_text()
    empty.mkdir()
    for line in (
        ["train", "experiment=walk", "ppo.max_iterations=1", "num_envs=4", "ppo.num_steps_per_env=4"],
        ["play", "trials=2", "viewer=none", "terminations.episode_length_s=0.2"],
        ["demo", "viewer=video", "video_s=0.2"],
    ):
        code = f"import omniperception.commands as c; print(c.__file__); c.main({line})"
        done = python(code, cwd=empty, env={**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"})
        assert done.returncode == 0 and done.stderr == "", done.stderr
        assert done.stdout.startswith(str(site))
    assert list(empty.glob("outputs/*/*/replay.json")) and (empty / "demo.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("modules", "use", "extra"),
    [
        (("trimesh",), lambda: TriangleMesh.from_file("rock.glb"), r"'omnilidar\[meshes\]'"),
        (("mujoco_lidar",), lambda: mid360("table"), r"'omnilidar\[tables\]'"),
        (("matplotlib",), lambda: new_figure(1.0, 1.0), "matplotlib"),
    ],
)
def test_a_missing_library_names_its_extra(monkeypatch, modules, use, extra):
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=f"pip install {extra}") as error:
        use()
    assert "\n" not in str(error.value)
    assert extra != "matplotlib" or isinstance(error.value, PlotsUnavailable)


def test_every_extra_that_is_named_exists():
    for project in (PROJECT, LIDAR, ROBOT):
        folders = ("omniperception", "packages", "docs/guide")
        texts = [
            path.read_text() for top in folders for path in (ROOT / top).rglob("*.*") if path.suffix in (".py", ".md")
        ]
        named = {extra for text in texts for extra in re.findall(rf"{project['name']}\[(\w+)\]", text)}
        assert named <= set(project["optional-dependencies"])
    assert set(EXTRA_OF.values()) <= set(PROJECT["optional-dependencies"])


def imported_at_once(path):
    """Libraries that a module imports when it is imported."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module.split(".")[0]


@pytest.mark.parametrize(
    ("folder", "project", "extras"),
    [
        ("omniperception", PROJECT, ("train",)),
        ("packages/lidar/omnilidar", LIDAR, ()),
        ("packages/robot/omnirobot", ROBOT, ()),
    ],
)
def test_only_dependencies_are_imported_before_they_are_used(folder, project, extras):
    required = [*project.get("dependencies", ()), *(r for e in extras for r in project["optional-dependencies"][e])]
    allowed = {MODULES.get(name, name.replace("-", "_")) for name in (re.match(r"[\w-]+", r).group() for r in required)}
    allowed |= {project["name"]}
    if project is PROJECT:
        allowed |= {"omnilidar", "omnirobot", "numpy", "torch", "warp"}
    for path in (ROOT / folder).rglob("*.py"):
        own = {path.stem} if path.parent.name == "log_writers" else set()  # the logger's that was asked for
        if path.parent.name == "recordings":  # the reader's that a file asks for; a package alone has none of them
            own = {{"mcap": "mcap", "rosbag1": "rosbags"}.get(path.stem)}
        for name in imported_at_once(path):
            assert name in allowed | own or name in sys.stdlib_module_names, f"{path}: {name}"


def test_no_distribution_takes_private_names_of_another():
    private = re.compile(r"from (omni\w+)[\w.]* import [^#\n]*\b_[a-z]")
    for folder, own in (("omniperception", PROJECT), ("packages/lidar/omnilidar", LIDAR), ("packages/robot", ROBOT)):
        for path in (ROOT / folder).rglob("*.py"):
            taken = [found.group() for found in private.finditer(path.read_text()) if found[1] != own["name"]]
            assert not taken, f"{path}: {taken}"


ALONE = {
    "lidar": CAST + "\nassert not {'hydra', 'mujoco', 'onnxruntime', 'cyclonedds'} & set(sys.modules)\n",
    "robot": """
import sys
import omnirobot.commands.replay, omnirobot.drive.control, omnirobot.drive.guard, omnirobot.wire.dds
from omnirobot.runtime import ExportedPolicy, RobotState

policy = ExportedPolicy.load(sys.argv[1])
pose = policy.description.joints.default_pos
targets = policy.step(RobotState(pose, [0] * 12, [1, 0, 0, 0], [0] * 3, [0] * 3), [0.5, 0, 0])
assert targets.shape == (12,) and abs(targets - pose).max() < 2.0
for name in ("torch", "warp", "mujoco", "hydra", "omniperception", "omnilidar", "mcap", "rosbags", "matplotlib"):
    try:
        __import__(name)
    except ModuleNotFoundError:
        continue
    raise AssertionError(f"{name} is here")
""",
}
"""What each package does by itself."""


@pytest.mark.parametrize("name", [pytest.param("lidar", marks=pytest.mark.slow), "robot"])
def test_a_package_alone_in_a_fresh_environment(name, tmp_path):
    """`pip install packages/<name>` brings all that its main job needs."""
    source, python_of = tmp_path / "source", tmp_path / "venv" / "bin" / "python"
    shutil.copytree(
        ROOT / "packages" / name, source, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    )
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    pins = ["torch==2.13.0"] if name == "lidar" else []  # the local build, without gigabytes for a GPU
    pip = [str(python_of), "-m", "pip", "install", "-q", "--no-compile", *pins, str(source)]
    done = subprocess.run(pip, capture_output=True, text=True, timeout=560)
    assert done.returncode == 0, done.stderr
    words = []
    if name == "robot":
        exported = tmp_path / "exported"
        main(["export", "run=pretrained/gait", "formats=onnx", f"out={exported}"])
        words = [str(exported)]
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [str(python_of), "-c", ALONE[name], *words], capture_output=True, text=True, cwd=tmp_path, env=env
    )
    assert done.returncode == 0, done.stderr
    if name == "robot":
        command = [str(python_of.parent / "omnirobot"), "drive", "policy=nowhere"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env)
        assert done.returncode == 2 and done.stderr.startswith("error: nowhere") and done.stderr.count("\n") == 1
