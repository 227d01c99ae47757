"""Learning curves: which runs are one curve, their mean, their range, and a running mean by hand."""

import numpy as np
import pytest
from omegaconf import OmegaConf
from torch.utils.tensorboard import SummaryWriter

from omniperception import config
from omniperception.commands import main
from omniperception.evaluation.report.curves import Curve, by_recipe, curves_of

TAG = "Metrics/velocity_error"


def make_run(folder, seed, values, num_envs=4, first=0, logger="tensorboard"):
    config.save({"seed": seed, "num_envs": num_envs, "logger": {"type": logger}}, folder)
    config.save_recipe(["experiment=walk", f"num_envs={num_envs}", f"seed={seed}"], folder)
    writer = SummaryWriter(str(folder))
    for step, value in enumerate(values):
        writer.add_scalar(TAG, value, first + step)
    writer.close()
    return folder


def test_runs_after_runs_that_differ_by_their_seed_are_one_curve(tmp_path):
    runs = [make_run(tmp_path / arm / f"seed{n}", n, [1.0]) for arm in ("after", "else") for n in (1, 2)]
    for run, lesson in zip(runs, ("a/lesson/seed1", "a/lesson/seed2", "a/seed1x", "a/seed2x"), strict=True):
        config.save({**OmegaConf.to_container(config.read(run)), "init": [lesson]}, run)
    assert list(by_recipe(runs).values()) == [runs[:2], [runs[2]], [runs[3]]]


def test_runs_that_differ_by_their_seed_are_one_curve(tmp_path):
    one = make_run(tmp_path / "one", 1, [4.0, 2.0, 1.0])
    two = make_run(tmp_path / "two", 2, [6.0, 4.0], logger="wandb")
    other = make_run(tmp_path / "other", 1, [9.0], num_envs=8)
    assert by_recipe([one, two, other]) == {"num_envs=4": [one, two], "num_envs=8": [other]}
    assert by_recipe([one, two]) == {"experiment=walk num_envs=4": [one, two]}
    same, alone = curves_of([one, two, other], [TAG])[TAG]
    assert same.steps.tolist() == [0, 1] and same.values.tolist() == [[4.0, 2.0], [6.0, 4.0]]
    assert alone.values.tolist() == [[9.0]]


def test_a_running_mean_has_fewer_values_at_the_beginning():
    curve = Curve("", np.arange(4), np.array([[1.0, 3.0, 5.0, 7.0]]))
    np.testing.assert_allclose(curve.smoothed(3), [[1.0, 2.0, 3.0, 5.0]])


def test_the_command_draws_and_prints_the_last_values(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "one", 1, [4.0, 2.0])
    make_run(tmp_path / "runs" / "two", 2, [6.0, 4.0])
    main(["curves", "runs=runs", f"tags={TAG}", "smooth=1"])
    assert "experiment=walk num_envs=4: 3 (n = 2, 2 to 4) at iteration 1" in capsys.readouterr().out
    assert (tmp_path / "outputs" / "curves.png").stat().st_size > 10_000


def test_what_no_run_has_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "one", 1, [4.0])
    make_run(tmp_path / "runs" / "late", 2, [4.0], first=10)
    given = {
        ("runs=nowhere",): "runs=nowhere is no run directory",
        ("runs=runs/one", "tags=Foo"): f"tags=Foo: no run has it, out of 1; known: {TAG}",
        ("runs=runs", f"tags={TAG}"): "have no iteration in common",
    }
    for arguments, message in given.items():
        with pytest.raises(SystemExit, match="2"):
            main(["curves", *arguments])
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
