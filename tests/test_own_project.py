"""The template in examples/own_project trains, plays and evaluates from a folder of its own."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.env.mdp.terms import StatefulTerm
from omniperception.evaluation.report.records import read
from omniperception.sim import MujocoSimulator, SimConfig

ROOT = Path(__file__).resolve().parents[1]
PRESETS = ("rewards", "obstacles", "terrain", "perception", "sim", "scenario", "experiment")
SMALL = ("num_envs=2", "ppo.num_steps_per_env=10", "ppo.num_mini_batches=1", "ppo.hidden_dims=[16]")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the template, and a command line in it."""
    folder = tmp_path_factory.mktemp("elsewhere") / "project"
    shutil.copytree(ROOT / "examples" / "own_project", folder, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}

    def run(*arguments):
        command = [sys.executable, "-m", "omniperception", *arguments]
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)

    return folder, run


@pytest.mark.slow
def test_it_trains_plays_and_evaluates(project):
    folder, run = project
    done = run("train", "--config-dir", "conf", "experiment=mine", *SMALL, "ppo.max_iterations=2", "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    saved = config.read(folder / "run")
    assert saved.search_path == [str(folder / "conf")]
    assert saved.rewards.terms.mechanical_power.func == "own_project.rewards.mechanical_power"
    short = ("trials=2", "terminations.episode_length_s=0.3")
    done = run("play", "run=run", "viewer=none", "obstacles=mine", *short)
    assert done.returncode == 2 and "trust=own_project" in done.stderr and done.stderr.count("\n") == 1
    done = run("play", "run=run", "viewer=none", "obstacles=mine", "trust=own_project", *short)
    assert done.returncode == 0, done.stderr
    done = run("evaluate", "run=run", "scenario=mine", "plots=false", "trust=own_project", *short)
    assert done.returncode == 0, done.stderr
    (path,) = (folder / "run" / "evaluation").glob("dev-ideal-mine-own-run-*.json")  # a hash of what was overridden
    (record,) = read(path)
    assert len(record.episodes) == 2


def test_its_presets_compose_and_are_built_of_its_own_parts(project, monkeypatch):
    folder, _ = project
    monkeypatch.syspath_prepend(str(folder))
    path = f"hydra.searchpath=['file://{folder / 'conf'}']"
    for group in PRESETS:
        assert "mine" in config.presets(group, [folder / "conf"])
    run = build.assemble(config.compose([path, "experiment=mine", *SMALL]))
    assert {"mechanical_power", "soft_landing", "closing_speed"} <= set(run.env.rewards.terms)
    runner = build.build_runner(run, None)
    landing = runner.env.rewards._terms["soft_landing"]
    assert isinstance(landing, StatefulTerm) and landing.stood.shape == (2, 4)
    frames, network = torch.rand(2, 6, 64, 3), runner.alg.actor.perception
    assert type(network).__name__ == "MaxPool"
    embedded = network(frames, torch.tensor([[0, 1, 4], [2, 3, 4]]))
    alone = network(frames[:1, :4], torch.tensor([[0]]))
    assert torch.equal(embedded[0, :1], alone[0]) and torch.equal(alone, torch.zeros_like(alone))
    last = network(frames[:1, 4:5].expand(1, 4, 64, 3), torch.tensor([[1]]))
    assert torch.allclose(embedded[0, 1], last[0, 0])
    tile = run.env.terrain.tiles["waves"]
    assert type(tile).__name__ == "Waves" and tile.height == (0.02, 0.2)


def test_its_motors_follow_late(project, monkeypatch):
    folder, _ = project
    monkeypatch.syspath_prepend(str(folder))
    page = (ROOT / "docs" / "guide" / "new_simulator.md").read_text()
    shown: dict = {"__name__": "own_project.shown"}
    exec(compile(page.split("```python")[1].split("```")[0], "new_simulator.md", "exec"), shown)
    path = f"hydra.searchpath=['file://{folder / 'conf'}']"
    run = build.assemble(config.compose([path, "experiment=walk", "sim=mine", "num_envs=3"]))
    world = build.build_runner(run, None).env.world
    own, on_the_page, exact = (
        settings.build(world, 3)
        for settings in (run.env.sim, shown["LateMotorsConfig"](time_constant_s=0.03), SimConfig())
    )
    target = exact.robot_state()[0][:, 7:] + 0.3
    for sim in (own, on_the_page, exact):
        before = sim.robot_state()[0][:, 7:]
        sim.step(target, num_steps=2)
        torch.testing.assert_close(sim._ctrl.float() - before, 0.3 * torch.full_like(before, sim_share(sim)))
    saved = own.state_dict()
    for sim in (own, on_the_page):
        sim.step(target, num_steps=2)
    assert torch.equal(own.qpos, on_the_page.qpos) and not torch.equal(own.qpos, exact.qpos)
    on_the_page.load_state_dict(saved)
    on_the_page.step(target, num_steps=2)
    assert torch.equal(own.qpos, on_the_page.qpos)
    own.step(target * float("nan"))
    assert own.failed.all()
    with pytest.raises(ValueError, match=r"sim\.time_constant_s=0 must be positive"):
        type(run.env.sim)(time_constant_s=0)


def sim_share(sim):
    """How much of a step reaches the motors within two physics steps of 5 ms."""
    return 1.0 if type(sim) is MujocoSimulator else 1.0 - math.exp(-0.01 / 0.03)
