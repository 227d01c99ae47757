"""A published run replays as the run that it was made from."""

import json
import os
import shutil

import pytest
import torch

from omniperception import build, config, publish
from omniperception.build import build_runner, load_policy
from omniperception.common import provenance
from omniperception.learning.checkpoint import (
    CheckpointError,
    checkpoint_path,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from omniperception.sim.response import FILE as RESPONSE


@pytest.fixture
def run(make_config, tmp_path):
    """A run directory with a checkpoint of everything."""
    run = make_config("experiment=avoid", "init=[seen,walked]", "terrain=flat", "num_envs=2", "lidar.num_rays=200")
    config.save(run.composed, tmp_path / "run")
    build_runner(run, None).save(str(checkpoint_path(tmp_path / "run", 0)))
    return tmp_path / "run"


def test_the_published_policy_acts_alike(run, tmp_path):
    record = publish.publish(run, tmp_path / "published")
    assert json.loads((tmp_path / "published" / provenance.FILE).read_text()) == record
    assert latest_checkpoint(tmp_path / "published").stat().st_size < latest_checkpoint(run).stat().st_size
    replays = [load_policy(build.assemble(config.load(folder)), folder) for folder in (run, tmp_path / "published")]
    obs = [trained.env.get_observations() for trained in replays]
    with torch.no_grad():
        assert torch.equal(*(trained.policy(o) for trained, o in zip(replays, obs, strict=True)))


def test_it_uses_all_cores_of_whatever_machine_it_is_on(make_config, tmp_path):
    run = make_config("experiment=walk", "num_envs=2", "sim.num_threads=1")
    config.save(run.composed, tmp_path / "run")
    build_runner(run, None).save(str(checkpoint_path(tmp_path / "run", 0)))
    publish.publish(tmp_path / "run", tmp_path / "published")
    assert config.load(tmp_path / "published").sim.num_threads == 0


def test_it_comes_from_where_the_run_does(run, tmp_path):
    provenance.write(run, {"commit": "0123abc", "date": "2026-01-31"})
    record = publish.publish(run, tmp_path / "published")
    assert record["commit"] == "0123abc" and record["run"] == str(run) and record["iterations"] == 0
    assert record["init"] == ["seen", "walked"]


def test_steps_are_those_of_all_processes(run, tmp_path, monkeypatch):
    newest = latest_checkpoint(run)
    state = load_checkpoint(newest, "cpu")
    state["logger"]["total_steps"] = 96
    save_checkpoint(newest, state)
    assert publish.publish(run, tmp_path / "published")["control_steps"] == 96


def test_another_run_starts_from_it(run, tmp_path, make_config):
    publish.publish(run, tmp_path / "published")
    runner = build_runner(build.assemble(config.load(run, ["seed=8"])), None)
    runner.start_from(tmp_path / "published")
    with pytest.raises(CheckpointError, match="holds weights alone, as published runs do"):
        runner.load(latest_checkpoint(tmp_path / "published"))
    weights = torch.load(latest_checkpoint(run), weights_only=True)["actor_state_dict"]
    assert all(torch.equal(value, weights[name]) for name, value in runner.alg.actor.state_dict().items())


def test_too_large_a_policy_is_refused(run, tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "LIMIT", 1000)
    with pytest.raises(config.ConfigError, match=r"MB of weights, at most 0 MB are published"):
        publish.publish(run, tmp_path / "published")


def test_a_training_is_not_published_over(run, tmp_path):
    before = latest_checkpoint(run).read_bytes()
    other = shutil.copytree(run, tmp_path / "other")
    for folder in (run, tmp_path / ".." / tmp_path.name / "run", other):
        with pytest.raises(config.ConfigError, match="holds a training, whose checkpoints would be lost"):
            publish.publish(run, folder)
    assert latest_checkpoint(run).read_bytes() == latest_checkpoint(other).read_bytes() == before


def test_nothing_of_others_is_published_over(run, tmp_path):
    kept = tmp_path / "theirs" / "evaluation" / "notes.txt"
    kept.parent.mkdir(parents=True)
    kept.write_text("mine")
    with pytest.raises(config.ConfigError, match="is no earlier publication and not empty; give a new folder"):
        publish.publish(run, tmp_path / "theirs")
    assert kept.read_text() == "mine"


def test_what_was_made_of_an_earlier_publication_goes(run, tmp_path):
    published = tmp_path / "published"
    publish.publish(run, published)
    for name in ("exported", "evaluation"):
        (published / name).mkdir()
    save_checkpoint(checkpoint_path(run, 3), load_checkpoint(latest_checkpoint(run), "cpu") | {"iteration": 3})
    publish.publish(run, published)
    assert sorted(path.name for path in published.iterdir()) == ["checkpoints", "config.yaml", provenance.FILE]
    assert [path.name for path in (published / "checkpoints").iterdir()] == ["model_3.pt"]


def test_the_response_that_was_measured_of_its_weights_goes_along(run, tmp_path):
    (run / RESPONSE).write_text("measured")
    publish.publish(run, tmp_path / "published")
    assert (tmp_path / "published" / RESPONSE).read_text() == "measured"
    later = (run / RESPONSE).stat().st_mtime + 60.0
    os.utime(latest_checkpoint(run), (later, later))  # learned on since
    publish.publish(run, tmp_path / "published")
    assert not (tmp_path / "published" / RESPONSE).exists()


def test_a_published_policy_is_not_published_again(run, tmp_path):
    publish.publish(run, tmp_path / "published")
    with pytest.raises(config.ConfigError, match="was published already"):
        publish.publish(tmp_path / "published", tmp_path / "again")
    assert not (tmp_path / "again").exists()
