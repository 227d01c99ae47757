"""A run as the viewer holds it: commands, clouds, obstacles by hand, weights."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from omniperception.config import ConfigError
from omniperception.evaluation.film.perceived import true
from omniperception.learning import CheckpointError
from omniperception.scene.rays import HitClass
from omniperception.viewer import Shown
from omniperception.viewer.session import DRAG_SPEED, Session, spare_kinds

PRETRAINED = Path(__file__).parents[2] / "pretrained"
OVERRIDES = ("terrain=flat", "obstacles=none", "condition=ideal", "lidar.num_rays=2000", "sim.num_threads=1")
NOISY = ("terrain=flat", "obstacles=none", "randomization=device", "lidar.num_rays=2000", "sim.num_threads=1")


@pytest.fixture(scope="module")
def session():
    shown = Session(Shown(PRETRAINED / "avoider", (*OVERRIDES, "terminations.episode_length_s=1000")))
    for _ in range(10):
        shown.step()
    return shown


def test_a_person_commands_and_gives_the_task_its_commands_back(session):
    own = session.env.command.value.clone()
    session.drive((0.7, -0.2, 0.3))
    expected = torch.tensor([[0.7, -0.2, 0.3]])
    for _ in range(25):  # the command that the gait observes changes by 4 m/s in a second
        session.step()
        assert torch.equal(session.env.command.value, expected)
    assert torch.equal(session.env.get_observations()["command"], expected)
    session.drive(None)
    session.env.command.time_left.fill_(0.0)
    session.step()
    assert session.driven is None
    assert not torch.equal(session.env.command.value, expected) and own.shape == (1, 3)


def step_to_a_frame(session, before=0):
    """Until the task's LiDAR has just cast, or will after `before` steps more."""
    session.step()
    while (session.env.step_count + before) % session.env.sensing.period_steps:
        session.step()


def shown_is_given(session):
    """Points shown are the noisy ranges that the task has cast: their distances from the sensor, whatever the
    directions."""
    given, shown = session.env.sensing.frame, session.cloud
    assert torch.equal(shown.valid, given.ranges.isfinite())
    sensor = session.env.config.lidar
    sensing = session.env.sensing
    place = sensing.scene.body_pos[0, sensing.carrier].numpy()
    hit = shown.valid[0]
    # a mount turned about and moved off the base
    quat = sensing.scene.body_quat[0, sensing.carrier].double()
    w, v, pos = quat[0], quat[1:], torch.tensor(sensor.mount_pos, dtype=torch.float64)
    mount = place + (pos + 2 * torch.linalg.cross(v, torch.linalg.cross(v, pos) + w * pos)).numpy()
    distance = np.linalg.norm(shown.points_w[0, hit].numpy() - mount, axis=1)
    assert distance == pytest.approx(given.ranges[0, hit].numpy(), abs=2e-5)


def test_points_are_those_that_the_policy_is_given(session):
    step_to_a_frame(session)
    shown_is_given(session)


def test_noisy_points_are_those_that_the_policy_is_given_in_every_trial():
    """Also after trials whose last step ended with a frame, which is not shown, and after another choice of rays."""
    session = Session(Shown(PRETRAINED / "avoider", NOISY))
    assert session.env.config.lidar_noise
    for trial in range(3):
        step_to_a_frame(session)
        shown_is_given(session)
        step_to_a_frame(session, before=1)
        casts = int(session.env.sensing.lidar.frame_count)
        session.reset()
        assert int(session.env.sensing.lidar.frame_count) == casts + 1 and session.cloud is None
        if trial == 1:
            session.show_cloud(500)
            step_to_a_frame(session)
            session.show_cloud(None)


def test_trials_end_anywhere_within_a_frame_of_several_segments():
    session = Session(Shown(PRETRAINED / "avoider", (*OVERRIDES, "lidar.motion_segments=5")))
    for steps in range(9, 16):  # a frame takes 5, a segment 1
        session.reset()
        for _ in range(steps):
            session.step()
        assert session.cloud is not None


def test_an_obstacle_is_brought_seen_dragged_and_taken_away(session):
    field, base = session.env.obstacles, session.env.state.kinematics.base_pos_w[0, :2]
    session.drive((0.0, 0.0, 0.0))
    assert not bool(field.root_active.any())
    yaw = float(session.env.state.kinematics.yaw[0])
    ahead = base.numpy() + 2.0 * np.array([math.cos(yaw), math.sin(yaw)])
    number = session.bring("cylinder", ahead.tolist())
    for _ in range(6):
        session.step()
    seen = session.cloud.class_id[0, session.cloud.valid[0]] == HitClass.OBSTACLE
    points = session.cloud.points_w[0, session.cloud.valid[0]][seen, :2].numpy()
    assert len(points) > 5
    assert np.hypot(*(points - ahead).T).max() < 0.3 + 0.01  # on a cylinder of at most 0.3 m
    assert np.isfinite(true(session.env).sectors[:, 0]).any()

    aside = ahead + np.array([0.0, 1.0])
    start = field.root_pos_w[0, number, :2].clone()
    session.hold(number, aside.tolist())
    session.step()
    moved = float((field.root_pos_w[0, number, :2] - start).norm())
    assert moved == pytest.approx(DRAG_SPEED * 0.02, rel=1e-3)
    assert float(field.velocity_w[0, session_part(session, number)].norm()) == pytest.approx(DRAG_SPEED, rel=1e-3)
    for _ in range(25):
        session.step()
    assert field.root_pos_w[0, number, :2].numpy() == pytest.approx(aside, abs=0.01)
    session.let_go(number)
    session.step()
    assert float(field.root_velocity_w[0, number].norm()) == 0.0

    session.take_away(number)
    for _ in range(6):
        session.step()
    assert not bool((session.cloud.class_id == HitClass.OBSTACLE).any())


def session_part(session, obstacle):
    return next(k for k, part in enumerate(session.env.obstacles.parts) if part.obstacle == obstacle)


@pytest.mark.parametrize("kind", ["box", "wall", "pole", "sphere", "capsule", "rock", "bar", "walker", "person"])
def test_every_kind_stands_on_the_ground_where_it_is_put(session, kind):
    assert kind in spare_kinds(session.env)
    field = session.env.obstacles
    x, y = (session.env.state.kinematics.base_pos_w[0, :2] + 3.0).tolist()
    number = session.bring(kind, (x, y))
    session.step()
    parts = [k for k, part in enumerate(field.parts) if part.obstacle == number]
    lowest = float((field.pos_w[0, parts, 2] - field.half_height[0, parts]).min())
    assert lowest == pytest.approx(0.3 if kind == "bar" else 0.0, abs=0.06)  # a leg swings
    assert np.hypot(*(field.root_pos_w[0, number, :2].numpy() - (x, y))) < 0.05
    session.take_away(number)


def test_a_kind_that_is_used_up_is_one_line(session):
    numbers = [session.bring("box", (4.0, k)) for k in (0.0, 2.0)]
    with pytest.raises(ValueError, match=r"^all 2 of kind box are there already; take one away"):
        session.bring("box", (4.0, 4.0))
    for number in numbers:
        session.take_away(number)


def test_a_push_changes_the_velocity_at_once(session):
    before = session.env.state.kinematics.base_lin_vel_w[0, :2].clone()
    session.push((0.5, -0.25))
    after = session.env.state.kinematics.base_lin_vel_w[0, :2]
    assert (after - before).tolist() == pytest.approx([0.5, -0.25], abs=1e-5)


def test_weights_of_another_network_are_refused_and_the_old_ones_walk_on(session):
    observations = session.env.get_observations()
    with torch.no_grad():
        before = session.policy(observations).clone()
    checkpoint = session.checkpoint
    for wrong in (PRETRAINED / "gait" / "checkpoints", PRETRAINED / "none"):
        path = next(iter(wrong.glob("*.pt")), wrong / "model_1.pt")
        with pytest.raises(CheckpointError) as raised:
            session.load(path)
        assert "\n" not in str(raised.value)
        with torch.no_grad():
            assert torch.equal(session.policy(observations), before)
    assert session.checkpoint == checkpoint
    session.load(checkpoint)
    with torch.no_grad():
        assert torch.equal(session.policy(observations), before)


def test_what_is_perceived_is_what_the_policy_acts_on(session):
    session.step()
    seen = session.perceived()
    risk = session.env.config.rewards.avoidance.risk
    assert seen.sectors.shape == (36, 3) and seen.risk.shape == (risk.num_candidates,)
    asked = session.env.state.reference[0, :2] + torch.from_numpy(seen.velocity)
    torch.testing.assert_close(asked, session.env.get_observations()["last_asked"][0, :2].float(), atol=1e-5, rtol=0)


def test_a_policy_that_does_not_exist_is_one_line():
    with pytest.raises(ConfigError, match=r"^policy=nobody is unknown; known: run, blind"):
        Session(Shown(PRETRAINED / "avoider", OVERRIDES, policy="nobody"))
