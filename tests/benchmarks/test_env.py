"""Rates of the environment: what is timed is what is reported, and a slower task is found slower."""

import pytest
from mujoco.batch import Batch

from benchmarks import env as benchmark

WALK = ("experiment=walk", "num_envs=4", "sim.num_threads=1", "ppo.num_steps_per_env=8")


@pytest.mark.parametrize("what", ["step", "iteration", "update"])
def test_every_study_counts_its_steps(make_config, what):
    run = make_config(*WALK)
    rates, *stages = benchmark.compare(what, run, repeats=1)
    others = ["bare Batch.step"] if what != "update" else []
    assert rates.column("timed") == [what, *others] and rates.column("CPU time to it")[0].startswith("1.00 ")
    for rate, us in zip(rates.column("env steps/s"), rates.column("us per env step"), strict=True):
        assert rate == pytest.approx(1e6 / us)
    if what == "step":
        (table,) = stages
        assert {"physics", "rewards", "observations"} <= set(table.column("stage"))
        assert 0.0 < sum(table.column("step")) < 3.0 * rates.column("us per env step")[0]


def test_bare_physics_takes_the_same_steps(make_config, monkeypatch):
    """As many engine steps per control step as the environment, from its states."""
    counted, step = [], Batch.step

    def counting(self, *args, nstep=1, **named):
        counted.append(nstep)
        return step(self, *args, nstep=nstep, **named)

    monkeypatch.setattr(Batch, "step", counting)
    timed = benchmark.step_of(make_config(*WALK))
    counted.clear()
    benchmark.physics_of(timed.env, 3).call(0)
    assert sum(counted) == 3 * timed.env.config.sim.decimation


def test_a_task_with_more_physics_is_slower(make_config):
    run, slower = make_config(*WALK), make_config(*WALK, "sim.timestep=0.0005", "sim.decimation=40")
    rates, stages = benchmark.compare("step", run, 3, slower)
    fast, slow = rates.column("CPU us per env step")
    assert rates.column("timed") == ["step", "against"] and slow > 1.5 * fast
    assert stages.columns == ["stage", "step", "against"]
