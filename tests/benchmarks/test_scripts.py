"""Scripts of studies are found, explain themselves and refuse nonsense without PYTHONPATH, from wherever one is."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STUDIES = sorted(path for path in (ROOT / "scripts").glob("*.py") if "import command" in path.read_text())
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
    assert len(STUDIES) >= 9 and done.stdout.count("usage: ") == done.stdout.count("arguments:") == len(STUDIES)
    assert not list(tmp_path.iterdir())


def test_a_script_and_a_module_refuse_nonsense(tmp_path):
    script = run([ROOT / "scripts" / "lidar_accuracy.py", "rays=no"], tmp_path)
    module = run(["-m", "benchmarks.lidar_accuracy", "rays=no"], ROOT)
    for done in (script, module):
        assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("error: rays=no must be a whole number")
