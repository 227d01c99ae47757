"""train.py: the configuration is saved first, and a resumed run is the uninterrupted one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from omniperception import build, config
from omniperception.commands import main
from omniperception.common import provenance
from omniperception.learning import CheckpointError, Runner, distributed, load_checkpoint
from omniperception.learning.checkpoint import checkpoint_path
from omniperception.learning.phases import Distil
from omnirobot.common.files import try_lock

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "num_envs=16",
    "seed=3",
    "ppo.num_steps_per_env=12",
    "ppo.num_learning_epochs=2",
    "ppo.num_mini_batches=2",
    "ppo.hidden_dims=[32,16]",
)
SMALL_CLOUD = ("perception.sampler.num_proximal=8", "perception.history=4")


def train(folder, *arguments):
    command = [sys.executable, str(ROOT / "train.py"), *arguments]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # faster for so little
    result = subprocess.run(command, cwd=folder, env=one_thread, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def checkpoint(folder, run, iteration):
    return load_checkpoint(folder / run / "checkpoints" / f"model_{iteration}.pt")


def test_the_configuration_is_saved_before_anything_uses_it(tmp_path, monkeypatch, capsys):
    """This run ends while its world is compiled: what it was is on the disk."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(["train", "num_envs=5", "robot.mounts.head.exclude_geoms=[nose]", "hydra.run.dir=here"])
    assert "nose" in capsys.readouterr().err
    saved = config.load(tmp_path / "here")
    assert saved.num_envs == 5 and list(saved.robot.mounts.head.exclude_geoms) == ["nose"]
    assert provenance.read(tmp_path / "here")["seed"] == saved.seed


def test_two_processes_do_not_train_in_one_directory(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["train", "experiment=walk", *SMALL, "ppo.max_iterations=1", "hydra.run.dir=here"]
    for again in (command, ["train", "run=here", "ppo.max_iterations=2"]):
        Path("here/checkpoints").mkdir(parents=True, exist_ok=True)
        with try_lock(tmp_path / "here" / "checkpoints") as alone:
            assert alone
            with pytest.raises(SystemExit, match="2"):
                main(again)
        assert "here: another process trains there" in capsys.readouterr().err
        main(again)
        assert "completed" in capsys.readouterr().out


def test_a_sweep_gives_every_run_a_directory(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sweep = ("experiment=walk", "seed=1,2", "hydra.sweep.dir=sweep", "hydra.sweep.subdir=${seed}")
    main(["train", "-m", *sweep, "num_envs=2", "ppo.num_steps_per_env=2", "ppo.max_iterations=1", *SMALL[3:]])
    assert capsys.readouterr().out.count("completed: 1 iterations") == 2
    for seed in (1, 2):
        assert config.read(tmp_path / "sweep" / str(seed)).seed == seed
        assert (tmp_path / "sweep" / str(seed) / "checkpoints" / "model_1.pt").is_file()


def test_a_sweep_takes_what_a_run_does_and_one_that_fails_does_not_end_it(tmp_path, monkeypatch, capsys):
    """A key that the preset leaves at its default; seed 1's checkpoint is not one."""
    monkeypatch.chdir(tmp_path)
    sweep = ["seed=1,2", "~condition", "hydra.sweep.dir=sweep", "+observations.command_acceleration=[4,8]"]
    command = ["train", "-m", "experiment=walk", *sweep, "num_envs=2", "ppo.num_steps_per_env=2", *SMALL[3:]]
    command += ["ppo.max_iterations=1"]
    main(command)
    assert list(config.read(tmp_path / "sweep" / "0").observations.command_acceleration) == [4, 8]
    assert "+observations.command_acceleration=[4,8]" in config.read_recipe(tmp_path / "sweep" / "1")
    for name in ("0", "1"):
        broken = tmp_path / "sweep" / name / "checkpoints" / "model_1.pt"
        (broken.write_bytes(b"no checkpoint") if name == "0" else broken.unlink())
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        main(command)
    said = capsys.readouterr()
    assert (
        said.out.count("completed: 1 iterations") == 1
        and (tmp_path / "sweep" / "1" / "checkpoints" / "model_1.pt").is_file()
    )
    with pytest.raises(SystemExit, match="2"):
        main(["train", "-m", "experiment=walk", "condition=null,robot"])
    assert "condition=null: condition names a preset" in capsys.readouterr().err
    assert "error: sweep/0: " in said.err and said.err.splitlines()[-1] == "error: 1 of 2 jobs failed: sweep/0"


def test_the_composed_configuration_is_printed(capsys):
    main(["train", "--cfg", "job", "num_envs=7"])
    assert yaml.safe_load(capsys.readouterr().out)["num_envs"] == 7


def test_a_gait_teaches_a_policy_that_perceives(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    quick = ("num_envs=2", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.mixed_precision=false", SMALL[-1])
    main(["train", "experiment=gait", *quick, "ppo.max_iterations=1", "hydra.run.dir=gait"])
    main(["train", "experiment=walk", *quick, "ppo.max_iterations=1", "hydra.run.dir=walk"])
    student = ("experiment=end_to_end", "init=gait", *quick, "lidar.num_rays=200", "terrain=flat")
    student += ("rewards.avoidance.threshold=0.01",)  # nothing is so near

    run = build.assemble(config.compose(list(student)))
    env = build.build_runner(run, None).env
    groups = env.get_observations()
    groups["avoidance_target"] = torch.tensor([[0.0, 0.0], [0.3, -0.2]])
    drawn = torch.get_rng_state()
    teacher = build.load_teacher(tmp_path / "gait", env)
    assert torch.equal(torch.get_rng_state(), drawn)  # or a run that goes on while it is taught goes another way
    walks = build.load_policy(build.load_run(tmp_path / "gait"), tmp_path / "gait").policy
    told = groups.clone()
    told["command"][1, :2] += torch.tensor([0.3, -0.2])
    with torch.no_grad():
        torch.testing.assert_close(teacher.actions(groups), walks(told))

    guesses = ("observations=gait_without_velocity", "ppo.max_iterations=1")
    main(["train", "experiment=gait", *quick, *guesses, "hydra.run.dir=guesses"])
    wants = ("observations=gait_without_velocity", "observations.estimated=null")
    history = config.read(tmp_path / "guesses").observations.groups.proprioception.history
    wants += (f"observations.groups.proprioception.history={history}",)
    other = build.build_runner(build.assemble(config.compose([*student, *wants])), None).env
    teacher, seen = build.load_teacher(tmp_path / "guesses", other), other.get_observations()
    walks = build.load_policy(build.load_run(tmp_path / "guesses"), tmp_path / "guesses").policy
    with torch.no_grad():  # what is estimated is not observed here
        torch.testing.assert_close(
            teacher.actions(seen.clone().set("avoidance_target", torch.zeros(2, 2))), walks(seen)
        )

    taught = "distillation={teacher: gait, iterations: 1}"
    lessons, imitate = [], Distil.update
    monkeypatch.setattr(Distil, "update", lambda *given: lessons.append(imitate(*given)) or lessons[-1])
    main(["train", *student, taught, "ppo.num_learning_epochs=1", "ppo.max_iterations=2", "hydra.run.dir=end"])
    (lesson,) = lessons
    assert lesson["imitation"] < 1e-10  # nothing near: but for rounding it did what its teacher did
    capsys.readouterr()
    for name in ("walk", "end"):
        with pytest.raises(SystemExit, match="2"):
            main(
                ["train", *student, f"distillation={{teacher: {name}, iterations: 1}}", f"hydra.run.dir={name}_taught"]
            )
        assert f"distillation.teacher={name}" in capsys.readouterr().err

    seen = ("init=[end,gait]", "ppo.max_iterations=1", *(one for one in student if not one.startswith("init=")))
    main(["train", *seen, "hydra.run.dir=same"])
    assert "init=end" not in capsys.readouterr().out
    main(["train", *seen, "perception.sampler.split_deg=10", "hydra.run.dir=other"])
    assert "learned from another sampler (split_deg 20.0 -> 10)" in capsys.readouterr().out
    main(["train", "init=end", *seen[1:], "perception.network.distal_dim=9", "hydra.run.dir=apart"])
    assert "init=end: its perception or its read-out has another form, and both stay" in capsys.readouterr().out

    timed = ("init=gait", "ppo.max_iterations=1", "observations.groups.clock.terms.gait_phase.frequency=4.0")
    main(["train", *(one for one in student if not one.startswith("init=")), *timed, taught, "hydra.run.dir=timed"])
    said = capsys.readouterr().out
    for name in ("init", "distillation.teacher"):
        assert f"{name}=gait: what it observes as gait_phase is made otherwise here (frequency 2.5 -> 4.0)" in said

    made = config.read(tmp_path / "gait")
    terms = made.observations.groups.proprioception.terms
    made.observations.groups.proprioception.terms = {"joint_vel": terms.pop("joint_vel"), **terms}
    (tmp_path / "gait" / "config.yaml").write_text(OmegaConf.to_yaml(made))
    with pytest.raises(CheckpointError, match="teacher=.*gait does not fit: input 0 .* proprioception.joint_pos_off"):
        build.load_teacher(tmp_path / "gait", env)
    made.observations.groups.clock.terms, made.lidar = {"avoidance_target": {}}, config.read(tmp_path / "end").lidar
    (tmp_path / "gait" / "config.yaml").write_text(OmegaConf.to_yaml(made))
    blind = build.build_runner(build.assemble(config.compose(["experiment=gait", *quick])), None).env
    with pytest.raises(CheckpointError, match="teacher=.*gait observes avoidance, which nothing here reads; give both"):
        build.load_teacher(tmp_path / "gait", blind)


def test_what_a_run_goes_on_with_is_written_down(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    quick = ("experiment=walk", "num_envs=2", "ppo.num_steps_per_env=4", *SMALL[3:])
    main(["train", *quick, "ppo.max_iterations=1", "hydra.run.dir=here"])
    for of_a_beginning in ("seed=9", "ppo.critic_warmup=9"):
        with pytest.raises(SystemExit, match="2"):
            main(["train", "run=here", of_a_beginning])
        assert f"{of_a_beginning}: here has begun already" in capsys.readouterr().err
    changed = [
        "ppo.max_iterations=2",
        "rewards.terms.velocity_tracking.weight=3.0",
        "ppo.schedule=fixed",
        "ppo.learning_rate=1e-5",
    ]
    main(["train", "run=here", *changed])
    saved = config.load(tmp_path / "here")
    assert saved.rewards.terms.velocity_tracking.weight == 3.0 and saved.ppo.max_iterations == 2
    assert config.read_recipe(tmp_path / "here")[-4:] == changed
    assert checkpoint(tmp_path, "here", 2)["learning_rate"] == 1e-5
    for wrong in ("ppo.hidden_dims=[8]", "ppo.start_std=0.5"):
        with pytest.raises(SystemExit, match="2"):
            main(["train", "run=here", wrong])
    with pytest.raises(SystemExit, match="2"):
        main(["train", "run=here", "ppo.schedule=adaptive", "ppo.learning_rate=1e-4"])
    assert "ppo.schedule=adaptive goes on from the checkpoint's" in capsys.readouterr().err
    assert config.load(tmp_path / "here") == saved


def test_what_cannot_be_trained_leaves_no_directory(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ("experiment=walk", "num_envs=1", "ppo.num_steps_per_env=2", "ppo.num_mini_batches=4")
    for wrong, message in ((given, "ppo.num_mini_batches=4"), (("init=nowhere",), "init=nowhere does not exist")):
        with pytest.raises(SystemExit, match="2"):
            main(["train", *wrong, "hydra.run.dir=here"])
        assert message in capsys.readouterr().err and not (tmp_path / "here").exists()


@pytest.mark.parametrize(
    "changes",
    [("randomization=none",), ("randomization=robot", "num_envs=3"), ("obstacles.curriculum=null",)],
    ids=("nothing random", "more robots", "all obstacles"),
)
def test_a_run_that_goes_on_in_another_task_begins_new_episodes(tmp_path, monkeypatch, capsys, changes):
    """Of the task before nothing stays: no drawn friction, no number of robots; but levels of curricula that go on."""
    monkeypatch.chdir(tmp_path)
    given = ["experiment=quickstart", *SMALL, *SMALL_CLOUD, "num_envs=2", "randomization=paper"]
    run = build.assemble(config.compose([*given, "+randomization.curriculum=null"]))
    config.save(run.composed, Path("here"))
    first = build.build_runner(run, None)
    first.env.obstacles.level = 0.7
    first.logger._return_so_far += 123.0
    first.logger.returns.append(5.0)
    first.save(checkpoint_path("here", 1))
    seen = []
    monkeypatch.setattr(Runner, "learn", lambda self, *_, **__: seen.append(self))
    main(["train", "run=here", "ppo.save_interval=7"])
    assert torch.equal(seen[0].env.sim.qpos, first.env.sim.qpos) and "another now" not in capsys.readouterr().out
    assert seen[0].logger._return_so_far.tolist() == [123.0, 123.0] and list(seen[0].logger.returns) == [5.0]
    main(["train", "run=here", *changes])
    assert "its task is another now: new episodes begin" in capsys.readouterr().out
    env, fresh = seen[1].env, build.build_runner(build.load_run(Path("here")), None).env
    assert env.num_envs == fresh.num_envs and bool((env.episode_length_buf == 0).all())
    assert not seen[1].logger._return_so_far.any() and not seen[1].logger.returns  # they were of other rewards
    assert env.obstacles.level == (1.0 if changes == ("obstacles.curriculum=null",) else 0.7)
    mass, nominal = (one.sim.model_field("body_mass") for one in (env, fresh))
    assert torch.equal(mass, nominal) == (changes[0] == "randomization=none")
    main(["train", "run=here"])  # stopped before it has saved anything of its task
    assert "its task is another now: new episodes begin" in capsys.readouterr().out


def test_processes_that_go_on_draw_from_streams_of_their_own(tmp_path, monkeypatch):
    given = ["experiment=quickstart", "obstacles.curriculum=null", *SMALL, *SMALL_CLOUD, "num_envs=2"]
    run = build.assemble(config.compose([*given, "lidar.num_rays=200", "randomization=paper"]))
    first = build.build_runner(run, None)
    first.save(tmp_path / "model_0.pt")
    monkeypatch.setattr(distributed, "rank", lambda: 1)
    second, alone = (build.build_runner(run, None) for _ in range(2))
    second.load(tmp_path / "model_0.pt")
    for runner in (first, second, alone):
        runner.env.random.start_episode(torch.arange(2))
    drawn = [runner.env.random.uniform(torch.arange(2)) for runner in (first, second, alone)]
    noise = [runner.env.sensing.lidar.state_dict()["seeded"] for runner in (first, second, alone)]
    for one, other, same in (drawn, noise):
        assert torch.equal(other, same) and not torch.equal(other, one)


@pytest.mark.parametrize("beginning", ["distillation={teacher: any, iterations: 1}", "ppo.critic_warmup=3"])
def test_a_beginning_of_learning_needs_a_policy_that_learns(beginning):
    with pytest.raises(config.ConfigError, match="ppo.num_learning_epochs=0 keeps it as it is"):
        build.assemble(config.compose(["experiment=avoid", "init=any", beginning]))


@pytest.mark.slow
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path):
    recipe = ("experiment=quickstart", "randomization=paper", *SMALL_CLOUD)
    train(tmp_path, *recipe, *SMALL, "ppo.max_iterations=4", "hydra.run.dir=whole")
    train(tmp_path, *recipe, *SMALL, "ppo.max_iterations=2", "hydra.run.dir=parts")
    halfway = checkpoint(tmp_path, "parts", 2)
    output = train(tmp_path, "run=parts", "ppo.max_iterations=4")
    assert "after 2 iterations" in output
    whole, parts = checkpoint(tmp_path, "whole", 4), checkpoint(tmp_path, "parts", 4)
    assert whole["iteration"] == parts["iteration"] == 4
    for part in ("actor_state_dict", "critic_state_dict"):
        assert whole[part].keys() == parts[part].keys()
        for name, value in whole[part].items():
            assert torch.equal(value, parts[part][name]), name
    before = halfway["actor_state_dict"]
    assert any(not torch.equal(value, before[name]) for name, value in whole["actor_state_dict"].items())
