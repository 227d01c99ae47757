"""What is measured of a gait's answer to asked velocities, on robots whose answer is known."""

import dataclasses
import json
import shlex
import shutil
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from omniperception.commands import main
from omniperception.evaluation.gait import response
from omniperception.evaluation.gait.response import Recording, _periodic, around_cycle, driven, falls_by_jump, reach
from omniperception.evaluation.gait.response_fit import fit, lagged
from omniperception.sim.response import FILE, Cycle, GaitResponse, NoResponse
from omnirobot.common.errors import ConfigError

GAIT = Path(__file__).resolve().parents[2] / "pretrained" / "gait"
DT, FINE = 0.02, 20


def simulated(
    gain, lag, delay, noise, noise_s, gain_sd=0.0, offset=0.0, offset_sd=0.0, robots=48, seconds=24, resets=()
):
    """Asked and reached velocities (T, robots, 3) and ends (T, robots): Euler's method in float64, FINE steps each."""
    rng = np.random.default_rng(7)
    steps, h = round(seconds / DT), DT / FINE
    target = np.repeat(rng.uniform(-1.5, 1.5, (seconds, robots, 3)), round(1 / DT), 0)
    done = np.zeros((steps, robots), bool)
    for step, robot in resets:
        done[step, robot] = True
    factor, offset = (
        gain + gain_sd * rng.standard_normal((robots, 3)),
        offset + offset_sd * rng.standard_normal((robots, 3)),
    )
    v, wander, u = np.zeros((robots, 3)), noise * rng.standard_normal((robots, 3)), np.zeros((robots, 3))
    past = [u] * (round(delay / h) + 1)
    asked, reached = [], []
    for step in range(steps):
        u = u + np.clip(target[step] - u, -0.12, 0.12)
        for _ in range(FINE):
            past = [*past[1:], u]
            v = v + h / lag * (factor * past[0] + offset - v)
        wander = wander * np.exp(-DT / noise_s)
        wander += noise * np.sqrt(1 - np.exp(-2 * DT / noise_s)) * rng.standard_normal((robots, 3))
        asked.append(u)
        reached.append(v + wander)
        ended = done[step][:, None]
        u, v = np.where(ended, 0.0, u), np.where(ended, 9.0, v)  # where it begins anew is not to matter
        past = [np.where(ended, 0.0, one) for one in past]
    return *(torch.tensor(np.array(one), dtype=torch.float32) for one in (asked, reached)), torch.tensor(done)


@pytest.mark.parametrize(
    ("gain", "lag", "delay", "noise", "noise_s"),
    [(0.9, 0.1, 0.06, 0.1, 0.3), (1.1, 0.3, 0.0, 0.2, 0.1), (0.7, 0.05, 0.13, 0.05, 0.6)],
)
def test_a_known_answer_is_found_again(gain, lag, delay, noise, noise_s):
    resets = [(333, 0), (334, 1), (700, 0), (900, 5)]
    differs = {"gain_sd": 0.08, "offset": 0.12, "offset_sd": 0.06}
    axes, predicted = fit(*simulated(gain, lag, delay, noise, noise_s, **differs, resets=resets), DT, 2.5)
    assert predicted.shape == (1200, 48, 3)
    for axis in axes.values():
        assert axis.gain == pytest.approx((gain, 0.08), abs=0.03)
        assert axis.lag_s[0] == pytest.approx(lag, rel=0.15) and axis.lag_s[1] < 0.3 * lag
        assert axis.delay_s[0] == pytest.approx(delay, abs=0.015) and axis.delay_s[1] < 0.02
        assert axis.offset == pytest.approx((0.12, 0.06), abs=0.03)
        assert axis.noise == pytest.approx(noise, rel=0.12)
        assert axis.noise_s == pytest.approx(noise_s, rel=0.3)


def test_what_swings_with_the_steps_counts_as_error_that_leads_nowhere():
    """A sine of 5 Hz and 0.2 m/s beside an error of 0.1 m/s for 0.3 s: the mean over 0.4 s is the latter's alone."""
    asked, reached, done = simulated(1.0, 0.1, 0.0, 0.1, 0.3)
    time = torch.arange(len(asked))[:, None, None] * DT
    axes, _ = fit(asked, reached + 0.2 * torch.sin(2 * torch.pi * 5 * time), done, DT, 2.5)
    for axis in axes.values():
        assert axis.noise == pytest.approx((0.1**2 + 0.2**2 / 2) ** 0.5, rel=0.1)
        ratio, other = 0.4 / axis.noise_s, 0.4 / 0.3
        left, known = (2 / r - 2 / r**2 * (1 - np.exp(-r)) for r in (ratio, other))
        assert axis.noise**2 * left == pytest.approx(0.1**2 * known, rel=0.25)


def test_a_step_comes_late_by_the_delay_and_rises_by_the_lag():
    """1 - exp(-t / lag) after 3 steps of nothing; half a step later where the delay is half a step longer."""
    whole = partial(torch.full, (1, 3), dtype=torch.float64)
    asked = torch.ones(10, 1, 3, dtype=torch.float64)
    done = torch.zeros(10, 1, dtype=torch.bool)
    done[7] = True
    x = torch.stack(list(lagged(asked, done, DT, whole(0.06), whole(0.1))))[:, 0, 0]
    passed = torch.tensor([0, 0, 0, 1, 2, 3, 4, 5], dtype=torch.float64) * DT
    torch.testing.assert_close(x[:8], 1 - torch.exp(-passed / 0.1), atol=1e-6, rtol=0.0)
    assert x[8] < x[7] / 3  # after the end it begins at 0
    late = torch.stack(list(lagged(asked, done, DT, whole(0.07), whole(1e-4))))[:, 0, 0]
    torch.testing.assert_close(late[:6], torch.tensor([0, 0, 0, 0.5, 1, 1], dtype=torch.float64), atol=1e-6, rtol=0.0)


def recording(**fields):
    nothing = torch.zeros(3, 2)
    given = {"jumps": nothing[0], "fell": nothing[0].bool(), "phase": nothing, "done": nothing.bool(), "dt": DT}
    three = torch.zeros(3, 2, 3)
    return Recording(**{"asked": three, "velocity": three, "pose": three, **given, **fields})


def test_falls_are_counted_by_the_size_of_the_jump():
    jumps = torch.tensor([0.1, 0.49, 0.5, 1.6, 1.7])
    fell = torch.tensor([False, True, False, True, True])
    assert falls_by_jump(recording(jumps=jumps, fell=fell)) == [
        (0.0, 0.5, 2, 1),
        (0.5, 1.0, 1, 0),
        (1.0, 1.5, 0, 0),
        (1.5, 2.0, 2, 2),
    ]
    assert falls_by_jump(recording(jumps=jumps[:0], fell=fell[:0])) == []


def test_poses_are_compared_with_the_nearest_cycle_at_their_phase():
    cycles = [
        Cycle((0.0, 0.0, 0.0), (0.2, 0.2), (0.0, 0.0), (0.0, 0.0), ()),
        Cycle((1.0, 0.0, 0.0), (0.3, 0.4), (0.1, -0.1), (0.0, 0.0), ()),
    ]
    asked, pose = torch.zeros(3, 2, 3), torch.zeros(3, 2, 3)
    asked[:, 1, 0] = 0.8
    phase = torch.tensor([[0.0, 0.1], [0.4, 0.6], [0.9, 0.8]])  # next to 0, 0.5 and 1
    pose[..., 0] = torch.tensor([[0.2, 0.3], [0.2, 0.4], [0.2, 0.3]])
    pose[..., 1] = torch.tensor([[0.0, 0.1], [0.0, -0.1], [0.0, 0.1]])
    pose[2] += 7.0  # does not count
    keep = torch.tensor([True, True, False])[:, None].expand(3, 2)
    height, tilt = around_cycle(recording(asked=asked, pose=pose, phase=phase), cycles, keep)
    assert (height, *tilt) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    pose[:2, 0, 2] = torch.tensor([0.1, -0.1])
    assert around_cycle(recording(asked=asked, pose=pose, phase=phase), cycles, keep)[1][1] == pytest.approx(
        0.5**0.5 / 10
    )


def test_a_cycle_begins_with_the_clock():
    """A wave whose period is no whole number of steps, noted at the ends of steps, read at 0, 1/16, ... of it."""
    phase = 1.6 * DT * torch.arange(151, 351, dtype=torch.float64) % 1.0

    def wave(at):
        return 0.3 + 0.1 * torch.sin(2 * torch.pi * at) - 0.05 * torch.cos(6 * torch.pi * at)

    found = _periodic(phase, torch.stack((wave(phase), -wave(phase)), 1)[:, None], True)
    even = torch.arange(16) / 16
    torch.testing.assert_close(found[:, 0, 0], wave(even).double(), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(found[:, 0, 1], -found[:, 0, 0])
    assert _periodic(0 * phase, phase[:, None], False).tolist() == [[pytest.approx(phase.mean().item())]]


BLIND = ("lidar=none", "perception=none", "rewards=walk", "observations=walk", "scenario=walk")


def test_robots_are_asked_as_fast_as_may_be_and_begin_again_at_nothing(make_env):
    """The second's legs are folded for a while, so that it falls."""
    env, seen = make_env(*BLIND, "num_envs=2"), []

    def policy(observations):
        seen.append(observations["command"].clone())
        actions = torch.zeros(2, 12)
        actions[1, 0::3] = 6.0
        return actions

    asked, done = [], []
    for one in driven(env, policy, lambda _: torch.tensor([[0.9, 1.2, -1.0]] * 2), 60):
        asked.append(one)
        done.append(env.done.clone())
    asked, done = torch.stack(asked), torch.stack(done)
    assert torch.equal(asked, torch.stack(seen))
    change = asked[:, 0].diff(dim=0)
    assert asked[0, 0, :2].norm() == pytest.approx(0.12) and asked[0, 0, 2] == pytest.approx(-0.16)
    assert change[:, :2].norm(dim=1).max() <= 0.12 + 1e-5 and change[:, 2].abs().max() <= 0.16 + 1e-5
    assert asked[-1, 0].tolist() == pytest.approx([0.9, 1.2, -1.0])
    assert not done[:, 0].any()
    (fell, *_) = done[:, 1].nonzero().flatten().tolist()
    assert asked[fell + 1, 1, :2].norm() == pytest.approx(0.12)
    with pytest.raises(ConfigError, match="the command alone"):
        next(driven(make_env(*BLIND, "num_envs=2", "+observations.groups.command.history=2"), policy, None, 1))


def test_the_reach_is_that_of_points_on_the_geoms(make_env):
    """Against points drawn on the surfaces of the robot's geoms by MuJoCo's own poses, at headings of all kinds."""
    env = make_env(*BLIND, "num_envs=3")
    model, state, rng = env.world.model, env.state.kinematics, np.random.default_rng(0)
    found = reach(env)
    pos, mat = (one.double().numpy() for one in env.sim.geom_poses(tuple(range(model.ngeom))))
    for robot in range(3):
        yaw = float(state.yaw[robot])
        ahead = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        most = np.zeros(2)
        for geom in range(model.ngeom):
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            unit = rng.standard_normal((4000, 3))
            unit /= np.linalg.norm(unit, axis=1, keepdims=True)
            size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
            if kind == mujoco.mjtGeom.mjGEOM_BOX:
                points = np.sign(unit) * size
            elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
                points = unit * size[0]
            elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
                points = unit * size[0] + np.sign(unit[:, 2:]) * [0.0, 0.0, size[1]]
            else:
                continue  # cylinders are taken as boxes: none of them is outermost
            world = points @ mat[robot, geom].T + pos[robot, geom] - state.base_pos_w[robot].numpy()
            most = np.maximum(most, np.abs(world[:, :2] @ ahead.T).max(0))
        assert found[robot].tolist() == pytest.approx(most.tolist(), abs=0.012)
        assert (found[robot].numpy() > most - 1e-4).all()


def test_the_command_writes_beside_the_weights_what_loads_again(tmp_path, monkeypatch, capsys):
    """As the message says that misses it. Of a few robots: enough to see units and signs."""
    run = shutil.copytree(GAIT, tmp_path / "run", ignore=shutil.ignore_patterns(FILE))
    monkeypatch.setattr(response, "SETTLES_S", 1.0)
    monkeypatch.setattr(response, "CYCLES_S", 1.2)
    with pytest.raises(NoResponse) as missing:
        GaitResponse.load(run)
    words = shlex.split(str(missing.value).rpartition(" gait ")[2])
    main(["gait", *words, "robots=8", "seconds=8", "conditions=robot", "sim.num_threads=1"])
    said = capsys.readouterr().out
    assert "| robot     | yaw  |" in said and "wrote" in said
    assert (run / "evaluation" / "gait-response.png").stat().st_size > 10_000
    found = GaitResponse.load(run)
    assert found.frequency == 2.5 and found.ranges["x"] == [-1.0, 2.0]
    assert 0.15 < found.radius < 0.35 and 0.0 < found.half_length < 0.3
    (name, condition), *others = found.conditions.items()
    assert name == "robot" and not others and sum(jumps for _, _, jumps, _ in condition.falls) > 40
    for axis in condition.axes.values():
        assert 0.6 < axis.gain[0] < 1.2 and 0.02 < axis.lag_s[0] + axis.delay_s[0] < 0.3
        assert 0.02 < axis.noise < 0.6 and 0.02 <= axis.noise_s < 1.0 and 2.0 < axis.acceleration < 25.0
    assert 0.0 < condition.height_sd < 0.05 and max(condition.tilt_sd) < 0.2
    assert [cycle.command[0] for cycle in found.cycles] == [0.0, 1.0, -0.5, 0.0, 0.0, 0.0, 0.0]
    for cycle in found.cycles:
        assert np.array(cycle.joints).shape == (16, 12) and 0.2 < min(cycle.height) <= max(cycle.height) < 0.4
        swing = np.ptp(np.array(cycle.joints), axis=0).max()
        assert swing > 0.3 if any(cycle.command) else swing < 0.1
    assert json.loads((run / FILE).read_text()) != dataclasses.asdict(found) and (run / FILE).stat().st_size < 40_000
