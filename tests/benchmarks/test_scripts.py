"""Scripts of studies are found, explain themselves and refuse nonsense without PYTHONPATH, from wherever one is."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
STUDIES = sorted(path for path in (ROOT / "scripts").glob("*.py") if "import command" in path.read_text())
WALK = "observations=walk rewards=walk perception=none"
NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
HELP_OF_ALL = """
import runpy, sys
scripts, sys.argv, path = sys.argv[1:], ["", "--help"], list(sys.path)
for script in scripts:
    sys.path[:] = [str(script.rpartition("/")[0]), *path[1:]]
    for name in [name for name in sys.modules if name.partition(".")[0] == "benchmarks"]:
        del sys.modules[name]
    runpy.run_path(script, run_name="__main__")
"""


def run(command, folder):
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run([sys.executable, *command], cwd=folder, capture_output=True, text=True, env=environment)


def test_help_shows_arguments_from_another_folder(tmp_path):
    done = run(["-c", HELP_OF_ALL, *map(str, STUDIES)], tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(STUDIES) == 6 and done.stdout.count("usage: ") == done.stdout.count("arguments:") == len(STUDIES)
    assert not list(tmp_path.iterdir())


def test_a_script_and_a_module_refuse_nonsense(tmp_path):
    script = run([ROOT / "scripts" / "lidar_accuracy.py", "rays=no"], tmp_path)
    module = run(["-m", "benchmarks.lidar_accuracy", "rays=no"], ROOT)
    for done in (script, module):
        assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("error: rays=no must be a whole number")


@pytest.mark.parametrize(
    ("study", "arguments", "expected"),
    [
        ("lidar.__main__", "what=nothing", "what=nothing"),
        ("lidar.__main__", "speed=3", "speed=3"),
        ("lidar.__main__", "repeats=many", "repeats=many"),
        ("lidar.__main__", "motions=fly", "motions=fly"),
        ("lidar.__main__", "device=cuda:99", "cuda:99"),
        ("stability.__main__", "subject=weather", "subject=weather must be one of physics, lidar, learning"),
        ("stability.__main__", "subject=lidar sim.timestep=0.1", "sim.timestep=0.1 is unknown for subject=lidar"),
        ("stability.__main__", "subject=lidar rays=0", "rays=0 must be"),
        ("stability.__main__", "subject=learning only=nothing_like_it", "runs nothing of subject=learning: one of "),
        ("stability.__main__", "subject=lidar only=far", "only=far runs nothing of subject=lidar: it is not divided"),
        ("lidar_accuracy", "only=nothing_like_it", "only=nothing_like_it is in no name of a case or room; cases are "),
        ("work_precision.__main__", "subject=lidr", "lidar, physics, policy"),
        ("work_precision.__main__", "subject=lidar only=shape", "only=shape"),
        ("work_precision.__main__", f"subject=lidar lidar=none {WALK}", "lidar=none"),
        ("work_precision.__main__", "subject=policy runs=/nowhere", "/nowhere"),
        ("work_precision.__main__", "subject=policy num_envs=4", "num_envs=4: policies are taken as they were trained"),
        pytest.param("gpu_check", "", "device=cuda:0", marks=NO_GPU),
    ],
)
def test_wrong_arguments_are_told_in_one_line(study, arguments, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        import_module(f"benchmarks.{study}").command(arguments.split())
    error = capsys.readouterr().err
    assert error.startswith("error: ") and expected in error and error.count("\n") == 1
