"""Loggers: what was logged is read back from where each of them keeps it; the console's line."""

import dataclasses
import io
import os
import sqlite3
import sys

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_env import ToyEnv, config

from omniperception.learning import Runner, latest_checkpoint, progress
from omniperception.learning.log_writers import LoggerConfig, LoggerError, MlflowConfig, TrackioConfig, WandbConfig

SETTINGS = {"seed": 7, "num_envs": 6, "ppo": {"gamma": 0.99}}


def train(run_dir, logger, iterations):
    """Trains, or goes on, as far as `iterations`."""
    torch.manual_seed(0)
    learning = dataclasses.replace(config(frames=False), logger=logger, settings=SETTINGS)
    run_dir.mkdir(parents=True, exist_ok=True)
    runner = Runner(ToyEnv(frames=False), learning, run_dir)
    if list(run_dir.glob("checkpoints/*")):
        runner.load(latest_checkpoint(run_dir))
    runner.learn(iterations - runner.current_learning_iteration)
    return runner


def scalars(run_dir, tag):
    """Values by iteration in the TensorBoard files."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {event.step: event.value for event in events.Scalars(tag)}


def test_tensorboard_holds_the_configuration(tmp_path):
    train(tmp_path, LoggerConfig(), 1)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    (text,) = events.Tensors("configuration/text_summary")
    assert b"gamma: 0.99" in text.tensor_proto.string_val[0]


def test_none_prints_lines_and_keeps_checkpoints_alone(tmp_path, capsys):
    train(tmp_path, None, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "progress.json"]
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_mlflow_goes_on_with_the_same_run(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "mlruns").as_uri())
    run_dir = tmp_path / "a" / "b"
    train(run_dir, MlflowConfig(project="legs"), 2)
    train(run_dir, MlflowConfig(project="legs"), 3)
    (run,) = mlflow.search_runs(experiment_names=["legs"], output_format="list")
    assert run.info.run_name == "a_b" and run.info.status == "FINISHED"
    assert run.data.params["ppo.gamma"] == "0.99" and run.data.params["seed"] == "7"
    logged = mlflow.MlflowClient().get_metric_history(run.info.run_id, "Loss/value")
    assert {m.step: m.value for m in logged} == pytest.approx(scalars(run_dir, "Loss/value"), rel=1e-6)
    assert {m.step for m in logged} == {0, 1, 2}


def test_trackio_goes_on_with_the_same_run(tmp_path, monkeypatch):
    trackio = pytest.importorskip("trackio")
    home = tmp_path / "home"
    for module in [module for name, module in sys.modules.items() if name.startswith("trackio")]:
        if hasattr(module, "TRACKIO_DIR"):
            monkeypatch.setattr(module, "TRACKIO_DIR", home)
    run_dir = tmp_path / "a" / "b"
    train(run_dir, TrackioConfig(project="legs"), 2)
    train(run_dir, TrackioConfig(project="legs"), 3)
    assert trackio.__version__
    (base,) = home.glob("legs*.db")
    with sqlite3.connect(base) as file:
        rows = file.execute("select run_name, step, metrics from metrics order by step").fetchall()
    assert len({name for name, _, _ in rows}) == 1 and [step for _, step, _ in rows] == [0, 1, 2]
    assert all("Loss/value" in str(metrics) for *_, metrics in rows)


def test_wandb_without_a_network(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    wandb.teardown()  # what ran before decided where it writes
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    train(tmp_path, WandbConfig(project="legs"), 2)
    (written,) = (tmp_path / "wandb").glob("offline-run-*/*.wandb")
    content = written.read_bytes()
    assert b"Loss/value" in content and b"gamma" in content
    assert set(scalars(tmp_path, "Loss/value")) == {0, 1}
    assert (tmp_path / "wandb_id.txt").read_text() in written.name


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(LoggerError, match=r"^logger=wandb needs wandb: pip install 'omniperception\[wandb\]'$"):
        WandbConfig().check()
    LoggerConfig().check()


class Screen(io.StringIO):
    def isatty(self):
        return True


class TestProgressLine:
    def test_on_a_terminal_one_line_is_written_over_and_cut(self, monkeypatch):
        screen = Screen()
        monkeypatch.setattr(sys, "stdout", screen)
        monkeypatch.setenv("COLUMNS", "12")
        line = progress.ProgressLine()
        line.show("1/2 | short")
        line.show("2/2 | much too long")
        assert "\n" not in screen.getvalue()
        shown = screen.getvalue().split("\r\x1b[K")[1:]
        assert shown == ["1/2 | short", "2/2 | much…"] and max(map(len, shown)) < 12
        line.end()
        line.end()
        assert screen.getvalue().endswith("…\n")

    def test_elsewhere_there_is_a_line_each(self, monkeypatch):
        plain = io.StringIO()
        monkeypatch.setattr(sys, "stdout", plain)
        line = progress.ProgressLine()
        line.show("one")
        line.show("two")
        line.end()
        assert plain.getvalue() == "one\ntwo\n"

    def test_nobody_who_reads_ends_nothing(self, monkeypatch):
        """As when Ctrl-C ends `tee`, too, and the training still has to save."""
        read, write = os.pipe()
        os.close(read)
        with open(write, "w") as pipe:
            monkeypatch.setattr(sys, "stdout", pipe)
            for text in ("one", "two"):
                progress.ProgressLine().show(text)
            assert sys.stdout is not pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), write)  # for what is left in it
