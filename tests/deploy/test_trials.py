"""Faults of the wire, tables of trials, and trials in real time."""

import json
import subprocess
import sys

import numpy as np
import pytest
from lockstep import ROOT

from omniperception import build, config
from omniperception.commands.robot_sim import world
from omniperception.deploy import trials
from omniperception.deploy.faults import FAULTS, Faults
from omniperception.deploy.trials import TrialsConfig, results, run, table
from omniperception.sim.mujoco import SimConfig
from omnirobot.common.errors import ConfigError
from omnirobot.runtime import DeployError
from omnirobot.wire.livox import read_points, write_points
from omnirobot.wire.messages import LOW_STATE, crc, sealed

PACKETS = [write_points(np.full((2, 3), 1.0), 1000 * k, k, 500_000) for k in range(20)]


def arrived(name, packets=PACKETS, now=1.0):
    faults = Faults(name, lasts_s=2.0)
    faults.begin(0.5)
    return [(packet.number, packet.times_ns[0]) for packet in map(read_points, faults.packets(now, packets))]


def test_packets_meet_their_fault():
    sent = [(k, 1000 * k) for k in range(20)]
    assert arrived("unplug") == [] and arrived("double") == [one for one in sent for _ in range(2)]
    assert arrived("shuffle") == [*sent[7::-1], *sent[15:7:-1]]
    assert arrived("clock") == [(k, at + 3600 * 10**9) for k, at in sent]
    dropped = arrived("drop", PACKETS * 50)
    assert 0.65 < len(dropped) / 1000 < 0.75 and set(dropped) == set(sent)
    for name in FAULTS:
        assert arrived(name, now=2.5) == sent  # it is over


def test_what_was_held_back_comes_at_the_end():
    faults = Faults("shuffle", lasts_s=2.0)
    faults.begin(0.0)
    assert len(faults.packets(1.0, PACKETS[:10])) == 8
    assert faults.packets(3.0, PACKETS[10:12]) == PACKETS[8:12]


def test_states_meet_their_fault():
    def state(name):
        faults = Faults(name, 2.0)
        faults.begin(0.0)
        data = faults.state(1.0, sealed(LOW_STATE.zeros()))
        return None if data is None else LOW_STATE.from_cdr(data)

    assert state("silence") is None and state("crc")["crc"] != crc(state("crc"))
    assert np.isnan(state("nan")["imu_state"]["quaternion"]).all() and state("nan")["crc"] == crc(state("nan"))
    assert state("unplug").tobytes() == sealed(LOW_STATE.zeros()).tobytes()


def a_result(trial, **changes):
    outcome = {"stood": True, "touched": False, "fell": False, "reached": True, "reached_s": 12.0, "height": 0.3}
    outcome |= {"speed": 1.0, "lag_s": 0.001 * trial} | changes
    robot = {"begin_ms": [0.0] * 99 + [11.0], "step_ms": [2.0] * 100, "period_ms": 20.0, "frames": 50}
    robot["counts"] = {"packets lost": 2, "frames missed": 3, "steps skipped": 1}
    return {
        "scenario": "moving",
        "fault": "none",
        "trial": trial,
        "limit_s": 30.0,
        "outcome": outcome,
        "robot": robot,
        "robot_exit": 0,
        "robot_said": "",
    }


def test_the_table_counts(tmp_path):
    """Four trials: one arrives, one touches, one is late, one falls. Wilson's interval of 1 of 4: 4.6 to 69.9 %."""
    changes = ({}, {"touched": True}, {"reached_s": 31.0}, {"fell": True, "reached_s": None, "height": 0.1})
    for k, change in enumerate(changes):
        (tmp_path / f"moving-none-{k:03d}.json").write_text(json.dumps(a_result(k, **change)))
    for k, why in enumerate(("p.onnx and policy.json are not from the same export", "motion_switcher is silent")):
        ended = a_result(k, stood=False) | {"fault": "swap", "robot": None, "robot_exit": 2, "robot_said": why}
        (tmp_path / f"moving-swap-{k:03d}.json").write_text(json.dumps(ended))
    lines = [" ".join(line.split()) for line in table(results(tmp_path)).splitlines()]
    one = "1 (25 % [5, 70])"
    none = "0 (0 % [0, 49])"
    assert lines[2] == f"| moving | none | 4 | {one} | {one} | {one} | {none} | {none} |"
    assert lines[3].endswith("| 1 (50 % [9, 91]) |")  # the other one was refused for another reason
    assert lines[7] == "| moving | none | 400 | 2.00 | 2.00 | 0.00 | 0.11 | 4 (1.0 %) | 4 | 200 | 12 | - | 8 | 2, 3 |"
    with pytest.raises(DeployError, match="holds no results of trials"):
        results(tmp_path / "none")


def test_what_cannot_be_tried_is_said(tmp_path):
    parts = {"run": "a", "out": tmp_path, "scenarios": ("moving",), "trials": 1, "limit_s": 30.0}
    with pytest.raises(DeployError, match="a folder that export has written was expected"):
        TrialsConfig(policy=tmp_path, faults=("none",), **parts)


def a_config(folder, **changes):
    (folder / "policy").mkdir(exist_ok=True)
    (folder / "policy" / "policy.json").write_text("{}")
    given = {"run": "a", "policy": folder / "policy", "out": folder / "out", "scenarios": ("moving",)}
    given |= {"faults": ("none",), "trials": 1, "limit_s": 30.0, "overrides": ["condition=ideal"]}
    return TrialsConfig(**{**given, **changes})


def test_results_of_something_else_are_not_taken_for_ones_own(tmp_path):
    config = a_config(tmp_path)
    config.out.mkdir()
    file = config.out / "moving-none-000.json"
    file.write_text(json.dumps(a_result(0) | {"made_with": config.made_with}))
    run(config)  # it is there
    for name, value in {"run": "b", "limit_s": 20.0, "overrides": ["condition=robot"]}.items():
        with pytest.raises(DeployError, match=f"moving-none-000.json is of another {name} .* give another folder"):
            run(a_config(tmp_path, **{name: value}))
    (tmp_path / "policy" / "policy.json").write_text('{"joints": 1}')
    with pytest.raises(DeployError, match="is of another policy"):
        run(config)
    file.write_text(json.dumps(a_result(0)))  # from before results said what they are of
    with pytest.raises(DeployError, match=r"is of another run \(unknown\), not a; give another folder"):
        run(a_config(tmp_path, scenarios=("corridor",)))


def test_half_a_result_is_named(tmp_path):
    path = tmp_path / "moving-none-000.json"
    for text in ("", '{"made_with": {"run": "r1"', "3"):
        path.write_text(text)
        with pytest.raises(DeployError, match=r"moving-none-000\.json is no result of a trial; delete it"):
            results(tmp_path)


def test_packages_that_the_run_may_name_reach_the_simulation(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(trials, "_Simulation", lambda words: started.append(words) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(a_config(tmp_path, trust=("one", "two")))
    assert "trust=one,two" in started[0] and "condition=ideal" in started[0]


def test_the_simulated_world_is_an_evaluations():
    """A run that was trained with a curriculum shows all obstacles; what the wire's timing needs is not to be had."""
    curriculum = "obstacles.curriculum={start_velocity_error: 0.12, max_velocity_error: 0.3, rise: 0.02}"
    env = world(ROOT / "pretrained" / "avoider", ["scenario=moving", curriculum])
    assert set(env.curriculum_levels) == {1.0} and env.config.trials and env.num_envs == 1
    with pytest.raises(ConfigError, match=r"num_envs=4: this command sets num_envs=1 itself; leave it out"):
        world(ROOT / "pretrained" / "avoider", ["num_envs=4"])
    with pytest.raises(ConfigError, match=r"sim.timestep=0.001: this command sets sim.timestep=0.002"):
        world(ROOT / "pretrained" / "avoider", ["sim.timestep=0.001"])
    with pytest.raises(ConfigError, match=r"sim=mujoco_warp: this command sets sim=mujoco"):
        world(ROOT / "pretrained" / "avoider", ["sim=mujoco_warp"])


def test_the_wire_is_mujocos_whatever_a_run_was_trained_in(tmp_path):
    run = build.load_run(ROOT / "pretrained" / "avoider", ["sim=mujoco_warp", "sim.device=cpu"])
    config.save(run.composed, tmp_path)
    env = world(tmp_path, ["scenario=static"])
    assert type(env.config.sim) is SimConfig and env.control_dt == pytest.approx(0.02)


@pytest.mark.slow
def test_three_processes_in_real_time(tmp_path):
    """The robot stands up and walks; when its policy is killed, it is damped and lies; another description is refused.

    How well it walks depends on the machine's other work and is not asserted.
    """
    for library in ("cyclonedds", "onnx", "onnxruntime"):
        pytest.importorskip(library)
    run = ROOT / "pretrained" / "avoider"

    def command(*words):
        done = subprocess.run(
            [sys.executable, "-m", "omniperception", *words], cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    command("export", f"run={run}", f"out={tmp_path / 'exported'}", "formats=onnx")
    words = (f"run={run}", f"policy={tmp_path / 'exported'}", "scenario=static", f"out={tmp_path / 'trials'}")
    said = command("robot-trials", *words, "faults=none,kill,swap", "trials=1")
    by_fault = {result["fault"]: result for result in results(tmp_path / "trials")}
    assert "| static | kill | 1 |" in said and by_fault["swap"]["robot_exit"] == 2
    assert not by_fault["swap"]["outcome"]["stood"] and by_fault["swap"]["robot"] is None
    assert by_fault["none"]["outcome"]["stood"] and len(by_fault["none"]["robot"]["step_ms"]) > 100
    killed = by_fault["kill"]
    assert killed["robot_exit"] == -9 and killed["outcome"]["height"] < 0.2 and not killed["outcome"]["fell"]
