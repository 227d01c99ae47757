"""Paths of any signs: overrides, arguments of commands, files that a configuration names, and what is written there."""

import os
import shlex
import shutil
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import yaml

from omniperception import config
from omniperception.commands import curves, evaluate, main, robot_new
from omniperception.evaluation.film.video import Recorder
from omniperception.evaluation.report.curves import Curve, draw_curves
from omniperception.scene.meshes import check_mesh, mesh_points
from omnirobot.common.cli import Command
from omnirobot.common.shell import command_line

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import HEXAPOD

ROOT = Path(__file__).resolve().parents[2]
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk", "obstacles=none", "num_envs=2")
SMALL = (
    *(*BLIND, "ppo.max_iterations=1", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1"),
    *("ppo.num_learning_epochs=1", "ppo.hidden_dims=[8]", "sim.num_threads=1", "logger=none"),
)
NAMES = (
    *("lr=3e-4", "lr=1,seed=2", "a#b", "a(b)", "run[1]", "a,b", "a:b", "my run", " before", "after ", "a$b", "$HOME"),
    *(
        "größe",
        "日本",
        "a~b",
        "a&b",
        "a;b",
        "a!b",
        "it's",
        'say "x"',
        "a\\b",
        "{b}",
        "a{b",
        "a<b",
        "a`b",
        "a\tb",
        "100%",
    ),
    *("1e3", "007", "2024", "true", "-x", "+x", "_x"),
)
ALL_SIGNS = "a=b,#(1) [x]; ü:$y&'q'"
KEYS = (
    *("init", "hydra.run.dir", "hydra.sweep.dir", "distillation.teacher", "robot.file", "terrain.file"),
    *("lidar.pattern.path", "obstacles.groups.rock.file", "+init", "++init"),
)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", NAMES)
def test_a_path_is_the_text_that_was_given(name):
    for path in (name, f"outputs/{name}"):
        for key in KEYS:
            (override,) = config.parse([f"{key}={path}"])
            assert override.value() == path, key


@pytest.mark.parametrize("name", ["lr=1,seed=2", "größe", "1e3"])
def test_a_path_is_composed_as_it_was_given(name):
    composed = config.compose([f"init={name}", "terrain=heights", f"terrain.file={name}"])
    assert (composed.init, composed.terrain.file) == (name, name)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("null", None),
        ("[a,b]", ["a", "b"]),
        ("[runs/lr=1,b(2)]", ["runs/lr=1", "b(2)"]),
        ('"runs/lr=1"', "runs/lr=1"),
        ("'a,b'", "a,b"),
        (r"runs/lr\=1", "runs/lr=1"),
        ("runs/seed=${seed}", "runs/seed=7"),
    ],
)
def test_what_hydras_grammar_says_of_paths_is_still_said(given, meant):
    assert config.compose([f"init={given}", "seed=7"]).init == meant


def test_a_path_may_begin_at_home(here, monkeypatch):
    monkeypatch.setenv("HOME", str(here))
    (here / "runs").mkdir()
    assert config.parse(["init=~/runs"])[0].value() == str(here / "runs") == str(config.find_run("~/runs"))
    assert Command(curves.main, curves.Arguments, "").parse(["out=~/c.png"])[0].out == here / "c.png"
    assert config.parse(["init=~nobody-at-all/runs"])[0].value() == "~nobody-at-all/runs"


def test_a_sweep_is_over_paths():
    jobs = config.jobs(config.parse(("init=runs/lr=1,runs/b;2", 'hydra.sweep.dir="a,b"'), sweeps=True))
    assert [config.compose(job).init for job in jobs] == ["runs/lr=1", "runs/b;2"]


def test_a_sweep_writes_where_it_is_told(here, capsys):
    main(["train", "-m", *SMALL, "hydra.sweep.dir=lr=1 (a)", "hydra.sweep.subdir=s=${seed}", "seed=1,2"])
    folder = here / "lr=1 (a)"
    assert sorted(run.name for run in folder.glob("*/")) == ["s=1", "s=2"]
    main(["train", "-m", *SMALL, f"init={folder}/s=1,{folder}/s=2", "hydra.sweep.dir=second"])
    assert [config.read(here / "second" / str(k)).init for k in range(2)] == [f"{folder}/s=1", f"{folder}/s=2"]


def test_text_in_other_keys_is_shown_as_a_shell_takes_it(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["train", "logger=wandb", "logger.project=it's a=b", "--cfg", "job"])
    error = capsys.readouterr().err
    assert error.startswith("error: logger.project=it's a=b: ") and error.count("\n") == 1
    (shown,) = shlex.split(error[error.index("'logger.project=") :])
    assert config.compose(["logger=wandb", shown]).logger.project == "it's a=b"


def test_a_run_of_any_name_is_trained_goes_on_and_is_read_by_every_command(here, capsys):
    run = f"runs/{ALL_SIGNS}"
    main(["train", *SMALL, f"hydra.run.dir={run}"])
    main(["train", *SMALL, f"init={run}", f"hydra.run.dir={run} 2"])
    assert config.read(Path(f"{run} 2")).init == run
    capsys.readouterr()
    main(["train", f"run={run}", "ppo.max_iterations=2"])
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1].endswith(command_line("play", f"run={run}").removeprefix("omniperception"))
    assert (here / run / "checkpoints" / "model_2.pt").is_file()
    short = ("trials=2", "terminations.episode_length_s=0.1")
    main(["play", f"run={run}", *short, "video_s=0.05", "video_size=64,36"])
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(here / run / "replay.mp4"))
    assert frames >= 1
    main(["export", f"run={run}", "formats=torchscript", f"out={run} 3"])
    main(["publish", f"run={run}", f"to=pretrained/{ALL_SIGNS}"])
    main(["evaluate", f"run={run}", "trials=2", "num_envs=2", "jobs=1", "scenario=walk", f"out={run}.json", short[1]])
    for written in (f"{run} 3/policy.pt", f"pretrained/{ALL_SIGNS}/config.yaml", f"{run}.json"):
        assert (here / written).is_file(), written
    capsys.readouterr()
    main(["runs", run])
    main(["runs", f"folder={run}"])
    assert capsys.readouterr().out.count(f"| {run} |") == 2


def test_the_first_word_may_be_a_path_with_an_equals_sign(here):
    (here / "lr=1").mkdir()
    (here / "lr=1" / "six.urdf").write_text(HEXAPOD)
    main(["robot-new", "lr=1/six.urdf", "out=lr=1/robot", "self_collision=false"])
    assert yaml.safe_load((here / "lr=1" / "robot" / "six.yaml").read_text())["file"] == "lr=1/six.urdf"
    parsed, _ = Command(robot_new.main, robot_new.Arguments, "", first="file").parse(["frequency=3", "file=a"])
    assert (parsed.frequency, parsed.file) == (3.0, Path("a"))


def test_several_paths_have_commas_between_them_or_in_them(here):
    for name in ("a,b", "[c]", "d"):
        (here / name).mkdir()
    for module, key in ((evaluate, "run"), (curves, "runs")):
        for given, meant in (
            ("a,b", ["a,b"]),
            ("[c]", ["[c]"]),
            ("d,[c]", ["d", "[c]"]),
            ("[d,e]", ["d", "e"]),
            ('"a,b",d', ["a,b", "d"]),
            ("x,y", ["x", "y"]),
        ):
            arguments, _ = Command(module.main, module.Arguments, "", overrides="of it").parse([f"{key}={given}"])
            assert getattr(arguments, key) == tuple(map(Path, meant)), given


def test_an_argument_may_be_quoted_as_an_override_is(here):
    arguments, _ = Command(curves.main, curves.Arguments, "").parse(['out="a b.png"', "runs='x'"])
    assert (arguments.out, arguments.runs) == (Path("a b.png"), (Path("x"),))


@pytest.mark.parametrize("name", [ALL_SIGNS, "it's", "a,b"])
def test_presets_are_found_in_a_folder_of_any_name(here, name, capsys):
    (here / name / "ppo").mkdir(parents=True)
    (here / name / "ppo" / "mine.yaml").write_text((config.CONFIG_DIR / "ppo" / "small.yaml").read_text())
    main(["train", "~experiment", "ppo=mine", "--config-dir", name, "--cfg", "job"])
    composed = yaml.safe_load(capsys.readouterr().out)
    assert composed[config.SEARCH_PATH] == [str(here / name)]
    run = here / "run"
    config.save(composed, run)
    assert config.load(run, ["ppo=mine"]).ppo == composed["ppo"]


def test_files_of_any_name_make_robots_ground_scans_and_obstacles(here, capsys):
    name = ALL_SIGNS
    folder = here / name
    folder.mkdir()
    for source, file in (
        (ROOT / "omniperception/scene/assets/go2.xml", "robot.xml"),
        (config.CONFIG_DIR / "terrain/example_heights.png", "heights.png"),
        (config.CONFIG_DIR / "lidar/example_scan.csv", "scan.csv"),
    ):
        shutil.copy(source, folder / file)
    (folder / "rock.obj").write_text(TETRAHEDRON)
    files = (f"robot.file={name}/robot.xml", "terrain=heights", f"terrain.file={name}/heights.png")
    main(["train", *SMALL, *files, "hydra.run.dir=run"])
    points, half = mesh_points(f"{name}/rock.obj")
    check_mesh(f"{name}/rock.obj")
    assert len(points) == 4 and half == (0.5, 0.5, 0.5)
    main(["scan", "lidar=custom", f"lidar.pattern.path={name}/scan.csv", f"out={name}/scan", "seconds=0.01"])
    assert (folder / "scan" / "scan.ply").is_file()


@pytest.mark.parametrize("folder", ["a:b", "-x", "%d"])
def test_a_film_is_written_where_ffmpeg_would_read_an_address_or_an_option(here, make_env, folder):
    (here / folder).mkdir()
    recorder = Recorder(make_env(num_envs=1, blind=True), Path(folder) / "film.mp4", 0.04)
    recorder()
    recorder()
    recorder.close()
    assert [path.name for path in (here / folder).iterdir()] == ["film.mp4"]
    assert imageio_ffmpeg.count_frames_and_secs(os.path.join(".", folder, "film.mp4"))[0] == 1


def test_a_picture_shows_a_name_that_looks_like_a_formula(here):
    pytest.importorskip("matplotlib")
    steps, values = np.arange(3), np.zeros((1, 3))
    draw_curves(here / "c.png", {"tag": [Curve("$x_$", steps, values), Curve("$y^$ $", steps, values)]}, 1)
    assert (here / "c.png").is_file()
