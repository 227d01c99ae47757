"""scripts/evaluate.py: results, determinism, files, baselines and mistakes."""

import csv
import json
import sys
from pathlib import Path

import pytest
import torch

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.common.figures import PlotsUnavailable
from omniperception.config import ConfigError
from omniperception.evaluation import suite
from omniperception.evaluation.baselines import steered
from omniperception.evaluation.suite import Evaluation, evaluate

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


def numbers(report: dict) -> dict:
    """What the same seed has to repeat: everything but wall times."""
    return {
        name: {key: value for key, value in summary.items() if key != "us_per_env_step"}
        for name, summary in report["policies"].items()
    }


def test_the_same_seed_gives_the_same_result_bit_for_bit(seeing, walker):
    def run_it(*overrides):
        policies = ["run", "blind", "scripted", "command"]
        given = {"trials": 6, "num_envs": 3, "walker": walker, "plots": False, "overrides": [SHORT, *overrides]}
        return evaluate(Evaluation(seeing, ["moving"], policies, **given))["moving"]

    first = run_it()
    table = (seeing / "evaluation" / "moving.csv").read_text()
    second = run_it()
    assert numbers(first) == numbers(second)
    assert (seeing / "evaluation" / "moving.csv").read_text() == table
    other = run_it("seed=8")
    assert numbers(other) != numbers(first) and other["seed"] == 8 and first["seed"] == 1005
    run, blind = first["policies"]["run"], first["policies"]["blind"]
    assert run["episodes"] == 6 and run["velocity_error_m_s"] != blind["velocity_error_m_s"]
    assert first["policies"]["command"]["checkpoint"].startswith(str(walker))
    assert run["checkpoint"].startswith(str(seeing))


def test_files_and_tables(walker, capsys):
    reports = evaluate(
        Evaluation(walker, ["static", "corridor"], ["run", "scripted"], trials=4, num_envs=2, overrides=[SHORT])
    )
    assert list(reports) == ["static", "corridor"]
    for scenario, report in reports.items():
        folder = walker / "evaluation"
        assert json.loads((folder / f"{scenario}.json").read_text()) == report
        assert report["time_limit_s"] == 0.3 and report["overrides"] == [SHORT]
        assert {"success", "collision", "rates_to_first_contact", "clearance_m"} <= set(report["definitions"])
        assert {"python", "torch", "mujoco-core"} <= set(report["versions"])
        with open(folder / f"{scenario}.csv") as file:
            rows = list(csv.DictReader(file))
        assert [row["policy"] for row in rows] == ["run"] * 4 + ["scripted"] * 4
        assert (folder / f"{scenario}.png").read_bytes()[:4] == b"\x89PNG"
    printed = capsys.readouterr().out
    assert "ending at the first contact" in printed and "scripted" in printed and "time out" in printed


def test_commands_are_clipped_only_for_a_policy_without_v_avoid(monkeypatch):
    """To the range of the walker's commands; a run that computes V_avoid itself is given all of it."""
    given = []

    def spy(env, policy, avoidance, limits):
        given.append(limits)
        return steered(env, policy, avoidance, limits)

    monkeypatch.setattr(suite, "steered", spy)
    run, walker = ROOT / "pretrained/avoider", ROOT / "pretrained/gait"
    for walks in (None, walker):
        suite._contender("scripted", Evaluation(run, ["static"], ["scripted"], trials=2, walker=walks), "static")
    assert given == [None, ((-1.0, 1.5), (-1.0, 1.0))]


def test_environments_default_to_even_rounds(walker):
    def envs(trials, **given):
        return Evaluation(walker, ["static"], trials=trials, **given).envs

    assert [envs(1000), envs(256), envs(257), envs(3)] == [250, 256, 129, 3]
    assert envs(1000, num_envs=7) == 7


def test_what_does_not_fit_the_run_is_refused(walker):
    with pytest.raises(ConfigError, match="scenario=rod is not an override here"):
        Evaluation(walker, ["static"], overrides=["scenario=rod"])
    with pytest.raises(ConfigError, match="policy=blind: this policy does not look at the LiDAR"):
        evaluate(Evaluation(walker, ["static"], ["blind"], trials=1, plots=False, overrides=[SHORT]))


def test_missing_matplotlib_is_refused_first(walker, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(PlotsUnavailable, match=r"pip install 'omniperception\[plots\]'"):
        evaluate(Evaluation(walker, ["static"], trials=1))


def test_the_number_of_threads_does_not_matter(walker):
    results = []
    for threads in (1, 2):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        given = [SHORT, f"sim.num_threads={threads}"]
        results.append(numbers(evaluate(Evaluation(walker, ["rod"], trials=4, plots=False, overrides=given))["rod"]))
        torch.set_num_threads(before)
    assert results[0] == results[1]
