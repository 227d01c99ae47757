"""Obstacles of several parts against MuJoCo's kinematics of jointed bodies, closed forms and points on surfaces."""

import math

import mujoco
import numpy as np
import pytest
import torch
from fields import make_field

from omniperception.scene import ObstacleGroup, ObstaclesConfig, PartConfig, SwingConfig

LEG = {"kind": "capsule", "size": [0.07, 0.36], "hang": 0.43}
AMPLITUDE, PER_METRE = 25.0, 0.7
PERSON = {
    "left": PartConfig(**LEG, pos=[0.0, 0.1, 0.9], swing=SwingConfig("y", AMPLITUDE, per_metre=PER_METRE)),
    "right": PartConfig(
        **LEG, pos=[0.0, -0.1, 0.9], swing=SwingConfig("y", AMPLITUDE, per_metre=PER_METRE, phase_deg=180)
    ),
    "trunk": PartConfig("cylinder", [0.17, 0.3], [0.0, 0.0, 1.2]),
}
DOOR = {
    "panel": PartConfig(
        "box", [0.45, 0.02, 1.0], [0.1, 0.2, 1.0], [0, 0, 30], [0.45, 0, 0], SwingConfig("z", 70.0, 0.2)
    ),
    "crank": PartConfig(
        "box", [0.1, 0.05, 0.02], [0.3, 0, 0.5], [20, -35, 50], 0.2, SwingConfig("x", 40.0, 0.5, 0.0, 90)
    ),
}
TABLE = {
    "top": PartConfig("box", [0.6, 0.35, 0.02], [0.0, 0.0, 0.72]),
    "leg": PartConfig("cylinder", [0.025, 0.35], [0.55, 0.3, 0.35]),
    "rail": PartConfig("cylinder", [0.02, 0.5], [0.0, 0.3, 0.2], [0.0, 90.0, 0.0]),
}
GROUPS = {
    "person": ObstacleGroup("compound", 2, speed=[0.5, 1.4], parts=PERSON, scale=[0.8, 1.2]),
    "crate": ObstacleGroup("box", 1, [[0.1, 0.3]] * 3),
    "door": ObstacleGroup("compound", 1, parts=DOOR, bottom=[0.2, 0.2]),
    "table": ObstacleGroup("compound", 1, parts=TABLE, scale=[0.5, 1.5]),
}
"""Obstacles 0 and 1, 2, 3, 4; parts 0 to 5, 6, 7 and 8, 9 to 11."""
N, DT = 6, 0.005


def field_of(groups=GROUPS, num_envs=N, seed=0, **settings):
    field = make_field(ObstaclesConfig(groups, **settings), num_envs, seed)
    field.reset(torch.arange(num_envs), torch.full((num_envs, 2), 50.0))
    return field


def travel(field, num_steps, calls=1):
    for _ in range(calls):
        paths = field.travel(DT, num_steps, torch.zeros(len(field.pos_w), 2))
    return paths


def jointed(parts):
    """A body that floats and carries a body on a hinge for each part."""
    spec = mujoco.MjSpec()
    root = spec.worldbody.add_body(name="root")
    root.add_freejoint()
    root.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=1.0)
    for name, part in parts.items():
        quat = np.zeros(4)
        mujoco.mju_euler2Quat(quat, np.radians(part.rpy_deg), "XYZ")  # about fixed axes, x first
        body = root.add_body(name=name, pos=part.pos, quat=quat)
        if part.swing is not None:
            axis = [float(part.swing.axis == a) for a in "xyz"]
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=part.hang, mass=1.0)
    return spec.compile()


@pytest.mark.parametrize(("group", "obstacle", "first"), [("person", 1, 3), ("door", 3, 7), ("table", 4, 9)])
def test_parts_are_where_mujoco_has_those_of_a_jointed_body(group, obstacle, first):
    """At scale s everything is s times as far from the root."""
    field = field_of()
    cycle = field.articulation.cycle.clone()
    speed = field.root_velocity_w.norm(dim=-1)
    travel(field, 4, 33)
    seconds = 33 * 4 * DT
    parts, model = GROUPS[group].parts, jointed(GROUPS[group].parts)
    data = mujoco.MjData(model)
    assert seconds * 0.5 * PER_METRE > 0.2  # people have done a part of a cycle
    for i in range(N):
        scale = float(field.articulation.scale[i, obstacle])
        yaw = float(field._root_yaw[i, obstacle])
        data.qpos[3:7] = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
        for name, part in parts.items():
            if part.swing is None:
                continue
            per_s = part.swing.frequency + part.swing.per_metre * float(speed[i, obstacle])
            turn = 2 * math.pi * (float(cycle[i, obstacle]) + per_s * seconds) + math.radians(part.swing.phase_deg)
            data.joint(name).qpos = math.radians(part.swing.amplitude_deg) * math.sin(turn)
        mujoco.mj_kinematics(model, data)
        for k, name in enumerate(parts):
            expected = field.root_pos_w[i, obstacle].numpy() + scale * data.geom(name).xpos
            np.testing.assert_allclose(field.pos_w[i, first + k].numpy(), expected, atol=1e-9)
            quat = field.quat_w[i, first + k].numpy()
            assert abs(quat @ data.body(name).xquat) == pytest.approx(1.0, abs=1e-9)


def test_roots_stand_at_their_bottoms_and_whole_obstacles_on_their_undersides():
    field = field_of()
    assert field.root_pos_w[..., 2].tolist() == [pytest.approx([0.0, 0.0, 0.0, 0.2, 0.0])] * N
    torch.testing.assert_close(field.pos_w[:, 6, 2], field.size[:, 6, 2])
    trunks = 1.2 * field.articulation.scale[:, :2]
    torch.testing.assert_close(field.pos_w[:, [2, 5], 2], trunks)


def test_a_compounds_sizes_vary_together():
    field = field_of(num_envs=500)
    scale = field.articulation.scale
    assert 0.5 <= scale[:, 4].min() < 0.51 and 1.49 < scale[:, 4].max() <= 1.5
    nominal = torch.tensor([[0.6, 0.35, 0.02], [0.025, 0.35, 0.0], [0.02, 0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(field.size[:, 9:], scale[:, 4, None, None] * nominal)
    assert field.varying == (*range(7), 9, 10, 11)  # the door has one size


def test_people_face_the_way_they_walk_and_their_legs_swing_against_each_other():
    field = field_of(area=(-1.0, 1.0, -1.0, 1.0))
    for _ in range(100):
        travel(field, 4)
        velocity = field.root_velocity_w[:, :2]
        heading = torch.stack((field._root_yaw[:, :2].cos(), field._root_yaw[:, :2].sin()), -1)
        torch.testing.assert_close(heading * velocity.norm(dim=-1, keepdim=True), velocity)
        angle = field.articulation.angles()
        torch.testing.assert_close(angle[:, [0, 3]], -angle[:, [1, 4]])
    assert field.articulation.turns and not field_of({"table": GROUPS["table"]}).articulation.turns


def test_velocities_are_those_of_the_parts_middles():
    field = field_of()
    travel(field, 1, 40)
    before, velocity = field.pos_w.clone(), field.velocity_w.clone()
    for sub in range(20):  # 0.1 ms each
        field.travel(1e-4, 1, torch.zeros(N, 2))
        if sub == 0:
            torch.testing.assert_close((field.pos_w - before)[..., :2] / 1e-4, velocity, atol=2e-3, rtol=0)
    assert velocity[:, [0, 1, 3, 4]].norm(dim=-1).max() > 1.5  # a foot that swings ahead is faster than its owner


def surface(kind, size, generator):
    """(2000, 3) points inside and on a shape, many on its rim."""
    u = torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    if kind == "box":
        return u.clamp(-0.7, 0.7) / 0.7 * size
    if kind == "cylinder":
        ring = u[:, :2] / u[:, :2].norm(dim=1, keepdim=True) * size[0]
        return torch.cat((ring, u[:, 2:].sign() * size[1]), 1)
    ball = u / u.norm(dim=1, keepdim=True) * size[0]
    return ball + torch.tensor([0.0, 0.0, 1.0]) * u[:, 2:].sign() * (size[1] if kind == "capsule" else 0.0)


def test_outlines_and_heights_hold_every_part_tightly_and_circles_around_obstacles_all_of_them():
    field = field_of()
    travel(field, 4, 21)
    generator = torch.Generator().manual_seed(0)
    for i in range(N):
        for k, part in enumerate(field.parts):
            points = surface(part.kind, field.size[i, k], generator)
            mat = np.zeros(9)
            mujoco.mju_quat2Mat(mat, field.quat_w[i, k].numpy())
            offset = points.numpy() @ mat.reshape(3, 3).T
            yaw = float(field.yaw[i, k])
            c, s = math.cos(yaw), math.sin(yaw)
            x, y = np.abs(c * offset[:, 0] + s * offset[:, 1]), np.abs(c * offset[:, 1] - s * offset[:, 0])
            half_x, half_y = field.outline[i, k].tolist()
            if half_y < 0:
                assert 0.98 * half_x <= np.hypot(*offset[:, :2].T).max() <= half_x + 1e-9, part.name
            else:
                assert 0.97 * half_x <= x.max() <= half_x + 1e-9 and 0.97 * half_y <= y.max() <= half_y + 1e-9, (
                    part.name
                )
            height = float(field.half_height[i, k])
            assert 0.97 * height <= offset[:, 2].max() <= height + 1e-9, part.name
            from_root = offset[:, :2] + (field.pos_w[i, k] - field.root_pos_w[i, part.obstacle])[:2].numpy()
            assert np.hypot(*from_root.T).max() <= float(field.root_radius[i, part.obstacle]) + 1e-9, part.name


def test_spacing_holds_between_all_that_compounds_cover():
    group = ObstacleGroup("compound", 3, parts=TABLE, scale=[0.5, 1.0])
    field = field_of({"table": group}, 200, spacing=0.4, area=(-4.0, 4.0, -4.0, 4.0))
    xy, radius = field.root_pos_w[..., :2], field.root_radius
    gap = (xy[:, :, None] - xy[:, None]).norm(dim=-1) - radius[:, :, None] - radius[:, None]
    both = field.root_active[:, :, None] & field.root_active[:, None] & ~torch.eye(3, dtype=torch.bool)
    assert gap[both].min() >= 0.4 - 1e-9 and both.float().mean() > 0.5
    assert torch.equal(field.active, field.root_active.repeat_interleave(3, 1))


def test_a_reset_of_one_environment_leaves_the_others_bit_identical():
    field = field_of(num_envs=4)
    travel(field, 4, 5)
    names = ("pos_w", "quat_w", "velocity_w", "active", "size", "outline", "half_height", "root_radius", "root_pos_w")
    before = {name: getattr(field, name).clone() for name in names}
    swings = {name: value.clone() for name, value in field.articulation.state_dict().items()}
    field.reset(torch.tensor([1]), torch.full((1, 2), 50.0))
    for name in names:
        assert torch.equal(getattr(field, name)[[0, 2, 3]], before[name][[0, 2, 3]]), name
    for name, value in field.articulation.state_dict().items():
        assert torch.equal(value[[0, 2, 3]], swings[name][[0, 2, 3]]), name
    assert not torch.equal(field.pos_w[1], before["pos_w"][1])


def test_a_loaded_state_goes_on_bit_identically():
    field, other = field_of(), field_of(seed=5)
    travel(field, 4, 7)
    other.load_state_dict(field.state_dict())
    other.pos_w.copy_(field.pos_w)  # the simulator's
    other.quat_w.copy_(field.quat_w)
    for name in ("outline", "half_height", "root_radius"):
        assert torch.equal(getattr(other, name), getattr(field, name))
    for path, other_path in zip(travel(field, 4, 3), travel(other, 4, 3), strict=True):
        assert torch.equal(path, other_path)


@pytest.mark.parametrize("sim", [("sim=mujoco",), ("sim=mujoco_warp", "sim.device=cpu")])
@pytest.mark.parametrize("terrain", ["flat", "mixed"])
def test_physics_follows_the_parts_step_by_step(make_env, sim, terrain):
    """Steps along a path are single steps with the bodies put there before each, orientations too."""
    person = {
        name: {"kind": part.kind, "size": list(part.size), "pos": list(part.pos), "hang": list(part.hang)}
        for name, part in PERSON.items()
    }
    swing = f"swing: {{axis: y, amplitude_deg: {AMPLITUDE}, per_metre: {PER_METRE}}}"
    parts = ", ".join(
        f"{name}: {{kind: {p['kind']}, size: {p['size']}, pos: {p['pos']}, hang: {p['hang']}"
        + (f", {swing}}}" if name != "trunk" else "}")
        for name, p in person.items()
    )
    group = f"+obstacles.groups.person={{kind: compound, count: 1, speed: [1.0, 1.4], parts: {{{parts}}}}}"
    one, other = (
        make_env(
            "obstacles=none", group, "obstacles.area=[-1,1,-1,1]", f"terrain={terrain}", *sim, num_envs=2, blind=True
        )
        for _ in range(2)
    )
    for k in range(5):
        path, turn = one.obstacles.travel(DT, 4, one.sim.qpos[:, :2])
        target = one.state.default_joint_pos.expand(2, -1)
        one.sim.step(target, 4, path, turn)
        for step in range(4):
            other.sim.mocap_pos.copy_(path[:, step])
            other.sim.mocap_quat.copy_(turn[:, step])
            other.sim.step(target, 1)
        assert torch.equal(one.sim.mocap_quat, other.sim.mocap_quat), k
        assert torch.equal(one.sim.qpos, other.sim.qpos), k
    assert (turn[:, 0] != turn[:, 3]).any()


def compound(**settings):
    return ObstacleGroup(**{"kind": "compound", "count": 1, "parts": TABLE, **settings})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SwingConfig("x", 20.0), "give one of them, positive"),
        (lambda: PartConfig("box", [1.0, 1.0]), r"size=\[1.0, 1.0\] of a box must be positive: half x"),
        (lambda: compound(size=[[1.0, 1.0]]), "leave out size"),
        (lambda: compound(parts={"a": PartConfig("mesh", file="rock")}, scale=[1.0, 2.0]), "among the parts: a"),
    ],
)
def test_wrong_compounds_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
