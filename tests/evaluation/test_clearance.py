"""Clearances by hand and against MuJoCo's own geometry."""

import math

import mujoco
import numpy as np
import pytest
import torch

from omniperception.evaluation.trials.clearance import Clearance, Geoms, clearances
from omniperception.evaluation.trials.clearance_kernels import BOX, TOLERANCE

BLIND = ("experiment=walk", "rewards=walk")


@pytest.mark.parametrize("scenario", ["static", "aerial", "rod"])
def test_the_robot_as_mujoco_measures_it(make_env, scenario):
    env = make_env(*BLIND, f"scenario={scenario}", "num_envs=6")
    clearance, model = Clearance(env), env.world.model
    robot = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == env.world.base_body]
    obstacles = [model.geom(name).id for name in env.world.obstacles.geom_names()]
    assert len(robot) == 19
    generator = torch.Generator().manual_seed(1)
    overlaps = 0
    for k in range(5):
        uniform = torch.rand(6, 18, generator=generator).double() - 0.5
        env.sim.qpos[:, :2] = env.sim.mocap_pos[:, k % env.sim.mocap_pos.shape[1], :2] + 1.4 * uniform[:, :2]
        env.sim.qpos[:, 2] = 0.33 + 0.1 * uniform[:, 2]
        quat = torch.cat((torch.ones(6, 1), uniform[:, 3:6]), 1)  # rolled, pitched and turned
        env.sim.qpos[:, 3:7] = quat / quat.norm(dim=1, keepdim=True)
        env.sim.qpos[:, 7:] = env.state.default_joint_pos + 0.5 * uniform[:, 6:]
        got = clearance.measure(torch.full((6,), 2.0))
        for i in range(6):
            model, data = env.sim.batch.get_model(i), env.sim.batch.get_data(i)  # with sizes of its own
            mujoco.mj_kinematics(model, data)
            pairs = [mujoco.mj_geomDistance(model, data, r, o, 2.0, None) for r in robot for o in obstacles]
            overlaps += min(pairs) < 0
            assert got[i].item() == pytest.approx(max(min(pairs), 0.0), abs=TOLERANCE + 1e-5)
    assert 0 < overlaps < 30


def test_only_what_is_nearer_than_the_bound_is_measured(make_env):
    env = make_env(*BLIND, "scenario=corridor", "num_envs=3")
    clearance = Clearance(env)
    # in the middle of the corridor the trunk's nearest wall is 2 m less half the robot's width away
    env.sim.mocap_pos[:, :6, 0] = 100.0  # the people
    env.sim.qpos[:, :2] = torch.tensor([[3.0, 0.0], [3.0, 1.0], [3.0, 0.0]]).double()
    far = clearance.measure(torch.full((3,), 9.0))
    assert 1.7 < far[0] < 1.9 and far[1].item() == pytest.approx(far[0].item() - 1.0, abs=2 * TOLERANCE)
    assert far[2] == far[0]
    bounded = clearance.measure(torch.tensor([0.5, 9.0, 0.0]))
    assert bounded[0] == 0.5 and bounded[1].item() == pytest.approx(far[1].item(), abs=TOLERANCE) and bounded[2] == 0


def test_a_diverged_environment_measures_nothing(make_env):
    env = make_env(*BLIND, "scenario=static", "num_envs=2")
    env.sim.qpos[0, :3] = math.nan
    assert Clearance(env).measure(torch.full((2,), 50.0)).isfinite().all()


def test_shapes_beyond_the_primitives_are_their_bounding_boxes():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.1, 0.2, 0.3])
    model = spec.compile()
    geoms = Geoms(model, [0], 1, torch.device("cpu"))
    assert geoms.kind.tolist() == [BOX]
    np.testing.assert_allclose(geoms.size[0, 0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert geoms.radius[0].item() == pytest.approx(math.sqrt(0.14))


def random_hulls(count, generator):
    """A model of `count` rocks, and their poses (count, 3), (count, 3, 3)."""
    spec = mujoco.MjSpec()
    for k in range(count):
        points = generator.normal(size=(generator.integers(4, 20), 3)) * generator.uniform(0.05, 0.3, 3)
        spec.add_mesh(name=f"rock_{k}", uservert=points.ravel())
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"rock_{k}")
    return spec


def test_shapes_as_mujoco_measures_them():
    """Every kind against every kind, near each other in random poses; penetration is 0."""
    rng = np.random.default_rng(0)
    spec = random_hulls(6, rng)
    kinds = 2 * ("box", "sphere", "cylinder", "capsule")
    for kind in kinds:
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=rng.uniform(0.05, 0.2, 3))
    model = spec.compile()
    data = mujoco.MjData(model)
    geoms = [Geoms(model, [k], 1, torch.device("cpu")) for k in range(model.ngeom)]
    couples = [(a, b) for a in range(model.ngeom) for b in range(model.ngeom) if a != b]
    expected, got = [], []
    for _ in range(10):
        data.mocap_pos[:] = rng.uniform(-0.6, 0.6, (model.nmocap, 3))
        data.mocap_quat[:] = rng.normal(size=(model.nmocap, 4))
        data.mocap_quat[:] /= np.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
        mujoco.mj_kinematics(model, data)
        pos = torch.tensor(data.geom_xpos, dtype=torch.float32)[None, :, None]
        mat = torch.tensor(data.geom_xmat, dtype=torch.float32).view(1, -1, 1, 3, 3)
        for a, b in couples:
            expected.append(max(mujoco.mj_geomDistance(model, data, a, b, 5.0, None), 0.0))
            pair = (geoms[a], pos[:, a], mat[:, a], geoms[b], pos[:, b], mat[:, b])
            got.append(clearances(*pair, torch.tensor([5.0])).item())
    expected = np.array(expected)
    assert 0.05 < (expected == 0).mean() < 0.6
    np.testing.assert_allclose(got, expected, atol=TOLERANCE + 1e-5)
