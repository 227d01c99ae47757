"""Runner: exact resume in a new process, atomic checkpoints, budgets, interrupts, logs."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_env import ToyEnv, config

from omniperception.learning import (
    CheckpointError,
    Runner,
    TrainingDiverged,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from omniperception.learning.checkpoint import checkpoint_path, difference, list_checkpoints

HERE = Path(__file__).parent


def runner_for(run_dir, frames=True, supervised=False, **ppo):
    torch.manual_seed(0)
    np.random.seed(0)
    return Runner(ToyEnv(frames=frames), config(frames, supervised, **ppo), run_dir)


def differences(a, b, where=""):
    """Paths at which two nested structures differ, timings aside."""
    if isinstance(a, dict):
        return [d for k in a if k != "total_time" for d in differences(a[k], b[k], f"{where}.{k}")]
    if isinstance(a, list | tuple):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}[{i}]")]
    same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    return [] if same else [where]


KINDS = {"end_to_end": {}, "supervised": {"supervised": True}, "blind": {"frames": False}}


def test_resume_in_a_new_process_is_exact(tmp_path):
    times = {}
    for kind, options in KINDS.items():
        runner_for(tmp_path / kind / "whole", **options).learn(5)
        part = runner_for(tmp_path / kind / "part", **options)
        part.learn(2)
        times[kind] = part.total_time
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *filter(None, sys.path)])}
    command = [sys.executable, str(HERE / "resume_process.py"), str(tmp_path), "3"]
    subprocess.run(command, check=True, env=environment, capture_output=True)
    for kind in KINDS:
        expected = load_checkpoint(checkpoint_path(tmp_path / kind / "whole", 5))
        resumed = load_checkpoint(latest_checkpoint(tmp_path / kind / "part"))
        assert resumed["iteration"] == 5 and resumed["total_time"] > times[kind]
        assert differences(expected, resumed) == [], kind


class TestCheckpoints:
    def test_saved_at_the_interval_and_at_the_end_and_pruned(self, tmp_path):
        runner_for(tmp_path / "all", save_interval=2).learn(5)
        assert [p.name for p in list_checkpoints(tmp_path / "all")] == ["model_2.pt", "model_4.pt", "model_5.pt"]
        runner_for(tmp_path / "two", save_interval=1, keep_checkpoints=2).learn(12)
        assert [p.name for p in list_checkpoints(tmp_path / "two")] == ["model_11.pt", "model_12.pt"]

    def test_leftovers_are_ignored_and_none_is_left(self, tmp_path):
        runner_for(tmp_path).learn(1)
        folder = tmp_path / "checkpoints"
        assert [p.name for p in folder.iterdir()] == ["model_1.pt"]
        for name in (".model_9.pt.123.tmp", "model_9.pt.tmp", "model_x.pt"):
            (folder / name).write_bytes(b"half")
        assert latest_checkpoint(tmp_path).name == "model_1.pt"

    def test_a_failed_write_keeps_the_old_file(self, tmp_path, monkeypatch):
        path = tmp_path / "model_1.pt"
        save_checkpoint(path, {"a": 1})

        def fail(content, file):
            file.write(b"half")
            raise OSError("disk full")

        monkeypatch.setattr(torch, "save", fail)
        with pytest.raises(OSError, match="disk full"):
            save_checkpoint(path, {"a": 2})
        assert load_checkpoint(path)["a"] == 1
        assert [p.name for p in tmp_path.iterdir()] == ["model_1.pt"]

    def test_bad_files_are_named_in_one_line(self, tmp_path):
        runner = runner_for(tmp_path)
        runner.learn(1)
        good = latest_checkpoint(tmp_path)
        damaged, foreign, text = (tmp_path / n for n in ("damaged.pt", "foreign.pt", "text.pt"))
        damaged.write_bytes(good.read_bytes()[:-500])
        torch.save({"model_state_dict": {}}, foreign)
        text.write_text("hello")
        for path, message in (
            (tmp_path / "none.pt", "no checkpoint at"),
            (damaged, "damaged"),
            (foreign, "no checkpoint of this program"),
            (text, "damaged or no checkpoint"),
            (tmp_path, "no checkpoint at"),
        ):
            with pytest.raises(CheckpointError, match=message) as error:
                runner.load(str(path))
            assert "\n" not in str(error.value) and str(path) in str(error.value)
        with pytest.raises(CheckpointError, match="no checkpoint in"):
            latest_checkpoint(tmp_path / "empty")

    def test_code_in_a_file_is_not_run(self, tmp_path):
        class Evil:
            def __reduce__(self):
                return (os.mkdir, (str(tmp_path / "evil"),))

        torch.save({"format": "omniperception-checkpoint", "x": Evil()}, tmp_path / "evil.pt")
        with pytest.raises(CheckpointError):
            load_checkpoint(tmp_path / "evil.pt")
        assert not (tmp_path / "evil").exists()

    def test_another_architecture_is_a_clear_error(self, tmp_path):
        runner_for(tmp_path).learn(1)
        with pytest.raises(CheckpointError, match=r"does not fit this configuration: their hidden layers") as error:
            Runner(ToyEnv(), config(hidden_dims=[4])).load(latest_checkpoint(tmp_path))
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({}, None),
            ({"mlp.2.weight": (3, 8)}, "they move 3 joints, this robot has 2"),
            ({"mlp.0.weight": (8, 7)}, "they read 7 numbers, this run has 5"),
            ({"mlp.0.weight": (4, 5), "mlp.2.weight": (2, 4)}, r"their hidden layers have \[4\] units, here \[8\]"),
            ({"perception.gru.weight": (4, 4)}, "they perceive with LiDAR, this run is to walk blind"),
            ({"estimator.0.weight": (4, 4)}, "they estimate the base's velocity, this run is to read"),
            ({"mlp.0.bias": None}, "they lack mlp.0.bias"),
            ({"mlp.0.bias": (9,)}, r"their mlp.0.bias has shape \(9,\), here \(8,\)"),
            ({"other": (1,)}, "they have other, which nothing here takes"),
            ({"mlp.0.weight": None, "mlp.2.weight": None}, "they are no actor's"),
        ],
    )
    def test_what_keeps_weights_out_is_said(self, change, said):
        shapes = {"mlp.0.weight": (8, 5), "mlp.0.bias": (8,), "mlp.2.weight": (2, 8)}
        own = {name: torch.zeros(shape) for name, shape in shapes.items()}
        other = {name: torch.zeros(shape) for name, shape in (shapes | change).items() if shape is not None}
        found = difference(own, other)
        assert found is None if said is None else re.search(said, found)

    def test_loading_the_actor_alone(self, tmp_path):
        runner_for(tmp_path).learn(1)
        env = ToyEnv(3)
        other = Runner(env, config())
        position, rng = env.position.clone(), torch.get_rng_state()
        other.load_policy(latest_checkpoint(tmp_path))
        assert other.current_learning_iteration == 0
        assert torch.equal(env.position, position) and torch.equal(torch.get_rng_state(), rng)
        policy = other.policy
        with torch.inference_mode():
            assert policy(env.get_observations()).shape == (3, 2)

    def test_nested_state_survives_and_unsavable_state_is_named(self, tmp_path):
        state = {
            "numbers": [1, 2.5, True, None, "x", np.float32(0.5), np.int64(7)],
            "arrays": {"f": np.eye(2), "u8": np.arange(3, dtype=np.uint8), "u32": np.arange(3, dtype=np.uint32)},
            "generator": np.random.default_rng(3).bit_generator.state,
            "view": torch.arange(1000)[3:5],
        }
        save_checkpoint(tmp_path / "s.pt", state)
        loaded = load_checkpoint(tmp_path / "s.pt")
        assert loaded["numbers"] == [1, 2.5, True, None, "x", 0.5, 7]
        assert torch.equal(loaded["arrays"]["f"], torch.eye(2, dtype=torch.float64))
        assert loaded["arrays"]["u32"].tolist() == [0, 1, 2]
        assert loaded["generator"] == state["generator"]
        assert loaded["view"].untyped_storage().nbytes() == 16
        with pytest.raises(CheckpointError, match=r"state\.env\.ids: a set"):
            save_checkpoint(tmp_path / "t.pt", {"env": {"ids": {1}}})


class TestLearn:
    def test_one_line_per_iteration(self, tmp_path, capsys):
        runner_for(tmp_path).learn(3)
        lines = capsys.readouterr().out.strip().splitlines()
        assert len(lines) == 3
        assert lines[2].startswith("3/3 | ")
        for part in ("steps/s", "collect", "learn", "reward", "length", "height_target", "velocity_error", "ETA"):
            assert part in lines[2]

    def test_scalars_are_those_of_rsl_rl(self, tmp_path):
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        runner_for(tmp_path).learn(3)
        events = EventAccumulator(str(tmp_path))
        events.Reload()
        tags = set(events.Tags()["scalars"])
        expected = {f"Loss/{name}" for name in ("value", "surrogate", "height_target", "learning_rate")}
        expected |= {"Policy/mean_std", "Perf/total_fps", "Train/mean_reward", "Train/mean_episode_length"}
        assert expected | {"Metrics/velocity_error"} <= tags
        assert [e.step for e in events.Scalars("Loss/height_target")] == [0, 1, 2]
        assert not (tmp_path / "git").exists()

    def test_without_a_run_directory_nothing_is_written(self, tmp_path, capsys, monkeypatch):
        monkeypatch.chdir(tmp_path)
        runner = runner_for(None)
        runner.learn(2)
        assert runner.current_learning_iteration == 2
        assert list(tmp_path.iterdir()) == [] and capsys.readouterr().out == ""

    def test_time_budget_counts_all_resumed_runs(self, tmp_path):
        runner = runner_for(tmp_path, max_minutes=10.0)
        runner.learn(2)
        assert runner.stop_reason == "completed"
        runner.total_time = 599.9999
        runner._save_checkpoint()
        runner.save(str(latest_checkpoint(tmp_path)))
        resumed = runner_for(tmp_path, max_minutes=10.0)
        resumed.load(str(latest_checkpoint(tmp_path)))
        resumed.learn(50)
        assert resumed.stop_reason == "time budget" and resumed.current_learning_iteration == 3
        assert latest_checkpoint(tmp_path).name == "model_3.pt"
        spent = runner_for(tmp_path, max_minutes=10.0)
        spent.load(str(latest_checkpoint(tmp_path)))
        spent.learn(50)
        assert spent.stop_reason == "time budget" and spent.current_learning_iteration == 3

    def test_the_eta_is_that_of_whichever_limit_comes_first(self, tmp_path, capsys):
        budget, runner = 1.0, runner_for(tmp_path, max_minutes=1.0, max_iterations=10**6)
        runner.total_time = 60.0 * budget - 5.0
        runner._iterate(self.ready(runner), last=10**6)
        assert 4 <= self.eta(capsys) <= 5
        runner.total_time = 0.0
        runner._iterate(runner.env.get_observations(), last=2)
        assert self.eta(capsys) == 0

    def ready(self, runner):
        runner.alg.train_mode()
        runner.logger.open(0)
        return runner.env.get_observations()

    def eta(self, capsys):
        hours, minutes, seconds = capsys.readouterr().out.strip().partition("ETA ")[2].partition(" |")[0].split(":")
        return 3600 * int(hours) + 60 * int(minutes) + int(seconds)

    @pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    def test_interrupt_saves_and_leaves(self, tmp_path, sent):
        runner = runner_for(tmp_path)
        update = runner.alg.update

        def update_then_interrupt():
            if runner.current_learning_iteration == 1:
                for _ in range(1 if sent == signal.SIGINT else 2):  # from a group's end, and from who started it
                    os.kill(os.getpid(), sent)
            return update()

        runner.alg.update = update_then_interrupt
        handler = signal.default_int_handler if sent == signal.SIGINT else signal.SIG_DFL
        before = signal.signal(sent, handler)  # SIGHUP may be ignored, as under nohup
        try:
            with pytest.raises(KeyboardInterrupt):
                runner.learn(50)
            assert signal.getsignal(sent) is handler
        finally:
            signal.signal(sent, before)
        assert latest_checkpoint(tmp_path).name == "model_2.pt"

    @pytest.mark.parametrize("what", ["rewards", "command"])
    def test_non_finite_environment_output_stops(self, tmp_path, what):
        runner = runner_for(tmp_path)
        step = runner.env.step

        def broken(actions):
            obs, rewards, dones, extras = step(actions)
            (rewards if what == "rewards" else obs[what])[4] = float("inf")
            return obs, rewards, dones, extras

        runner.env.step = broken
        with pytest.raises(TrainingDiverged, match=f"{what}, first in environment 4"):
            runner.learn(1)
        assert list_checkpoints(tmp_path) == []

    def test_training_improves_the_reward(self, tmp_path):
        runner = runner_for(tmp_path, num_steps_per_env=16)
        runner.learn(8)  # about 40 episodes
        start = float(np.mean(runner.logger.returns))
        runner.learn(60)
        assert float(np.mean(list(runner.logger.returns)[-40:])) > 0.8 * start
