"""scripts/evaluate.py: results, determinism, files, resuming, the log, baselines and mistakes."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.common.provenance import provenance
from omniperception.common.random import EnvRandom
from omniperception.config import ConfigError
from omniperception.evaluation import suite
from omniperception.evaluation.report.records import read
from omniperception.evaluation.suite import Evaluation, Task, World, evaluate, reported_seed, suite_worlds
from omniperception.evaluation.trials.baselines import baseline
from omniperception.learning import CheckpointError, latest_checkpoint
from omnirobot.runtime.description import checksum

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("num_envs=2", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1")
SHORT = "terminations.episode_length_s=0.3"


def make_run(path: Path, *overrides: str) -> Path:
    run = build.assemble(config.compose([*overrides, *SMALL]))
    config.save(run.composed, path)
    build_runner(run, path).learn(1)
    return path


@pytest.fixture(scope="module")
def walker(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("walker"), "experiment=walk")


@pytest.fixture(scope="module")
def seeing(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("seeing"), "experiment=quickstart", "obstacles.curriculum=null")


def evaluation(run_dir, *worlds, **given):
    given = {"trials": 4, "num_envs": 2, "jobs": 1, "overrides": (SHORT,)} | given
    return Evaluation([run_dir], [World(name) for name in worlds], **given)


def by(monkeypatch, commit):
    """From now on measured by code at this commit."""
    monkeypatch.setattr(suite, "provenance", lambda device: {**provenance(device), "commit": commit})


def outcomes(records):
    """What the same seed has to repeat: everything but wall times."""
    return [(record.policy, record.world, record.seed, record.episodes.columns()) for record in records]


def test_the_same_seed_gives_the_same_result_in_any_process(seeing, walker):
    given = {"policies": ("run", "blind", "oracle"), "trials": 6, "num_envs": 3, "walker": walker, "again": True}
    first = evaluate(evaluation(seeing, "moving", **given))
    assert outcomes(evaluate(evaluation(seeing, "moving", jobs=2, **given))) == outcomes(first)
    (run, blind, oracle) = (record.episodes for record in first)
    assert len(run) == 6 and not torch.equal(run.velocity_error, blind.velocity_error)
    assert not torch.equal(oracle.velocity_error, blind.velocity_error)
    assert [record.facts["walker"] == first[0].run for record in first] == [True, True, False]
    other = evaluate(evaluation(seeing, "moving", **given | {"policies": ("run",), "overrides": (SHORT, "seed=8")}))
    assert other[0].seed == 8 and first[0].seed == 1005 and outcomes(other) != outcomes(first)[:1]


def test_files_hold_what_was_measured_and_by_what(walker, tmp_path, capsys):
    given = {"policies": ("run", "oracle"), "plots": True, "out": tmp_path / "all.json.gz"}
    records = evaluate(evaluation(walker, "static", "corridor", **given))
    folder = walker / "evaluation"
    assert [(r.world, r.policy) for r in records] == [(w, p) for w in ("static", "corridor") for p in ("run", "oracle")]
    for record in records:
        (path,) = folder.glob(f"dev-ideal-{record.world}-own-{record.policy}-????????-4.json")  # overrides have a name
        (written,) = read(path)
        assert written.plain() == record.plain()
        facts = written.facts
        assert facts["time_limit_s"] == 0.3 and facts["overrides"] == [SHORT] and facts["trials"] == 4
        assert {"date", "commit", "command", "machine", "versions", "checkpoint"} <= set(facts)
        assert {"python", "torch", "mujoco-core"} <= set(facts["versions"])
    assert [record.key for record in read(tmp_path / "all.json.gz")] == [record.key for record in records]
    printed = capsys.readouterr().out
    for policy in ("run", "oracle"):
        (picture,) = folder.glob(f"dev-ideal-{policy}-????????-4.png")
        assert picture.read_bytes()[:4] == b"\x89PNG" and str(picture) in printed
    assert printed.count("| static") == 2 and "mean of 2" in printed


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"runs": "twice"}, "policy=run world=rod is given twice"),
        ({"runs": "empty"}, "no checkpoint in"),
        ({"out": "other.json"}, "other.json holds no results of evaluate"),
    ],
    ids=lambda given: next(iter(given)) if isinstance(given, dict) else "",
)
def test_what_would_fail_after_the_trials_is_refused_before(walker, tmp_path, monkeypatch, given, message):
    (tmp_path / "other.json").write_text("{}")
    shutil.copytree(walker, tmp_path / "empty", ignore=shutil.ignore_patterns("checkpoints", "evaluation"))
    runs = {"twice": [walker, walker / ".." / walker.name], "empty": [walker, tmp_path / "empty"]}
    given = given | ({"runs": runs[given["runs"]]} if "runs" in given else {})
    given = given | ({"out": tmp_path / given["out"]} if "out" in given else {})
    monkeypatch.setattr(suite, "run_episodes", lambda *_, **__: pytest.fail("it was measured"))
    with pytest.raises((ConfigError, CheckpointError), match=message):
        evaluate(replace(evaluation(walker, "rod"), **given))


def test_the_same_command_goes_on_where_it_was(walker, monkeypatch, capsys):
    measured = []
    real = suite.run_episodes

    def count(env, *args, **kwargs):
        measured.append(env.config.seed)
        if len(measured) == 2:
            raise KeyboardInterrupt
        return real(env, *args, **kwargs)

    monkeypatch.setattr(suite, "run_episodes", count)
    by(monkeypatch, "one")
    given = evaluation(walker, "aerial", "small", trials=3)
    with pytest.raises(KeyboardInterrupt):
        evaluate(given)
    records = evaluate(given)
    assert len(measured) == 3 and [record.world for record in records] == ["aerial", "small"]
    assert outcomes(evaluate(given)) == outcomes(records) and len(measured) == 3
    assert "2 of 2 measured before and kept" in capsys.readouterr().out
    half = given.tasks()[0].path
    half.write_text(half.read_text()[:100])
    assert outcomes(evaluate(given)) == outcomes(records) and len(measured) == 4
    del measured[3:]
    evaluate(evaluation(walker, "aerial", trials=2))  # something else is measured
    evaluate(evaluation(walker, "aerial", trials=2, again=True, plots=True))
    assert len(measured) == 5
    evaluate(evaluation(walker, "aerial", trials=2))
    evaluate(evaluation(walker, "aerial", trials=2, plots=True))  # its ways are there
    assert len(measured) == 5
    by(monkeypatch, "another")
    evaluate(evaluation(walker, "aerial", trials=2))  # by other code
    assert len(measured) == 6 and not list((walker / "evaluation").glob("*-aerial-*.npz"))
    by(monkeypatch, "another+changes")
    for _ in range(2):
        evaluate(evaluation(walker, "aerial", trials=2))  # nothing says whether that code was the same
    assert len(measured) == 8


def test_seeds_of_reported_evaluations_follow_from_the_weights(walker):
    seeds = {reported_seed(weights, world) for weights in ("0a", "0b") for world in ("static", "corridor")}
    assert len(seeds) == 4 and min(seeds) >= 2**31
    assert reported_seed("0a", "static") == reported_seed("0a", "static")
    draws = EnvRandom(2**31 + 2**42 - 1, 3).uniform(torch.arange(3), (4,))  # the largest
    assert len(draws.unique()) == 12
    task = Task(evaluation(walker, "static", overrides=()), walker, "run", World("static"))
    assert task.composed.seed == 1002
    with pytest.raises(ConfigError, match="the seed of split=test follows from the weights"):
        evaluation(walker, "static", split="test", overrides=("seed=4",))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("worlds: [walk", "must have 'worlds: .*while parsing"),
        ("worlds: [walk]", "must have 'worlds: "),
        ("worlds: {walk: []}", "names no world"),
    ],
)
def test_a_file_that_is_no_suite_is_one_line(text, message, tmp_path):
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        suite_worlds("mine", [tmp_path])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("world", suite_worlds("held_out"), ids=lambda world: f"{world.name}-{world.terrain}")
def test_every_world_of_the_suite_can_be_evaluated(walker, world):
    Task(evaluation(walker, world.name), walker, "run", world).assembled()


def test_commands_are_clipped_only_for_a_policy_without_v_avoid(monkeypatch):
    """To the range of the walker's commands; a run that computes V_avoid itself is given all of it."""
    controllers, given = [], []

    def spy(name, env, policy, avoidance, limits):
        controllers.append(avoidance)
        given.append(limits)
        return baseline(name, env, policy, avoidance, limits)

    monkeypatch.setattr(suite, "baseline", spy)
    run, walker = ROOT / "pretrained/avoider", ROOT / "pretrained/gait"
    for walks in (None, walker):
        heavy = ("rewards.avoidance.risk.weight=3.0", "navigation.risk.weight=3.0")
        changed = evaluation(run, "static", walker=walks, overrides=heavy)
        Task(changed, run, "oracle", World("static"))._contender()
    assert given == [None, ((-1.0, 2.0), (-1.5, 1.5))]
    assert [controller.risk.weight for controller in controllers] == [3.0, 3.0]


def test_overrides_reach_run_scene_and_gait():
    """Those of the robot and the scene reach the gait's task as well; those of a goal's world are not the run's."""
    run, walker = ROOT / "pretrained/avoider", ROOT / "pretrained/gait"
    given = ("robot.kp=40.0", "commands.speed=0.5", "lidar.num_rays=123")
    changed = evaluation(run, "moving", walker=walker, policies=("run", "oracle"), overrides=given)
    for policy in ("run", "oracle"):
        task = Task(changed, run, policy, World("moving"))
        env = task.assembled().env
        assert (env.robot.kp, env.commands.speed, task._own.lidar.num_rays) == (40.0, 0.5, 123)


def test_results_with_another_gait_or_another_file_of_presets_stand_apart(walker, tmp_path):
    gait = tmp_path / "other"
    shutil.copytree(walker, gait)
    alone, driven = (
        Task(evaluation(walker, "static", walker=w), walker, "oracle", World("static")) for w in (None, gait)
    )
    (fewer,) = evaluation(walker, "static", trials=2, policies=("oracle",)).tasks()
    (other,) = evaluation(walker, "static", overrides=("sim.cone=elliptic",), policies=("oracle",)).tasks()
    for name in ("path", "picture"):
        assert len({getattr(task, name) for task in (alone, driven, fewer, other)}) == 4
    record = evaluate(evaluation(walker, "static", policies=("oracle",)))[0]
    assert replace(record, facts=record.facts | {"walker": "b"}).key != record.key
    folder = tmp_path / "conf" / "scenario"
    folder.mkdir(parents=True)
    hashes = []
    for speed in (0.5, 0.6):
        text = (ROOT / "conf/scenario/moving.yaml").read_text()
        (folder / "mine.yaml").write_text(re.sub(r"speed: .*", f"speed: {speed}", text, count=1))
        mine = evaluation(walker, "mine", overrides=(SHORT, f"hydra.searchpath=[file://{tmp_path / 'conf'}]"))
        hashes.append(Task(mine, walker, "run", World("mine")).settings()["configuration"])
    assert hashes[0] != hashes[1]


def test_without_a_condition_all_have_the_runs_randomization(walker, tmp_path):
    """Whoever walks: a gait of another randomization."""
    other = make_run(tmp_path / "other", "experiment=walk", "randomization=paper", "randomization.added_mass=[1.0,2.0]")
    for runs, walks in ((walker, other), (other, walker)):
        changed = evaluation(runs, "static", walker=walks, condition=None, policies=("run", "oracle"))
        rows = [Task(changed, runs, policy, World("static")).composed["randomization"] for policy in ("run", "oracle")]
        assert rows[0] == rows[1] and (rows[0]["added_mass"] is None) == (runs == walker)
        Task(changed, runs, "oracle", World("static")).assembled()
    for given, there in (("randomization=none", None), ("randomization.added_mass=[3.0,3.5]", [3.0, 3.5])):
        changed = evaluation(other, "static", walker=walker, condition=None, overrides=(given,))
        for policy in ("run", "oracle"):
            assert Task(changed, other, policy, World("static")).composed["randomization"]["added_mass"] == there


def test_results_with_another_content_of_a_file_or_a_trusted_module_stand_apart(walker, tmp_path, monkeypatch):
    plan, module = tmp_path / "plan.png", tmp_path / "own_terms_of_a_test"
    module.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    hashes = []
    for level, text in ((255, "A = 1"), (254, "A = 1"), (254, "A = 2"), (254, "A = 2")):
        Image.fromarray(np.full((60, 60), level, np.uint8)).save(plan)
        (module / "__init__.py").write_text(text)
        given = {"overrides": ("terrain=plan", f"terrain.file={plan}"), "trust": ("own_terms_of_a_test",)}
        task = Task(evaluation(walker, "static", **given), walker, "run", World("static"))
        hashes.append(task.settings()["configuration"])
    assert len(set(hashes[:3])) == 3 and hashes[2] == hashes[3]


def test_what_was_measured_beside_a_failure_is_noted(walker, tmp_path, monkeypatch):
    """And is found again; one process fails at once, while the other measures."""
    by(monkeypatch, "0a")
    log = tmp_path / "log.jsonl"
    given = {"split": "test", "log": log, "overrides": ()}
    both = evaluation(walker, "static", policies=("run", "histogram"), jobs=2, **given)
    with pytest.raises(ConfigError, match="policy=histogram: this policy needs a LiDAR"):
        evaluate(both)
    assert [json.loads(line)["policy"] for line in log.read_text().splitlines()] == ["run"]


def test_two_runs_of_one_name_are_refused_before_the_trials(walker, tmp_path, monkeypatch):
    runs = [tmp_path / arm / "net" / "seed1" for arm in ("a", "b")]
    for run in runs:
        shutil.copytree(walker, run)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    twice = Evaluation(runs, [World("static")], trials=4, num_envs=2, jobs=1, overrides=(SHORT,))
    with pytest.raises(ConfigError, match=r"would both be called net/seed1; evaluate them from a folder above"):
        evaluate(twice)


def test_reported_evaluations_have_other_obstacles_and_seeds_and_are_noted_once(walker, tmp_path, monkeypatch):
    log = tmp_path / "log.jsonl"
    by(monkeypatch, "one")
    given = evaluation(walker, "static", "rod", split="test", log=log)
    records = evaluate(given)
    assert [record.seed for record in records] == [reported_seed(records[0].weights, w) for w in ("static", "rod")]
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert {record.split for record in records} == {"test"} and [line["world"] for line in lines] == ["static", "rod"]
    assert lines[0]["weights"] == records[0].weights == checksum(latest_checkpoint(walker)) and lines[0]["trials"] == 4
    names = {"date", "commit", "changes", "command", "condition", "condition_version", "policy", "versions"}
    assert names <= set(lines[0]) and "+" not in lines[0]["commit"]
    assert outcomes(evaluate(given)) == outcomes(records)
    assert len(log.read_text().splitlines()) == 2  # nothing was measured
    task = Task(given, walker, "run", World("static"))
    assert task.assembled().env.obstacles.split == "test"
    assert suite.log_file(evaluation(walker, "static")) == suite.ROOT / suite.LOG
    monkeypatch.setattr(suite, "ROOT", tmp_path)  # outside of a checkout
    assert suite.log_file(evaluation(walker, "static")) == walker / "evaluation" / "evaluations.jsonl"
    with pytest.raises(ConfigError, match="scenario=rod is not an override here"):
        evaluation(walker, "static", overrides=("scenario=rod",))
