"""Robots from files of others: what touches, what rays hit, joints by name, gains, URDF, mounts."""

import dataclasses
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from omniperception.scene import Mount, ObstacleGroup, ObstaclesConfig, RobotConfig, TerrainConfig, build_world
from omniperception.scene.rays import ray_shapes
from omniperception.scene.robot_file import parse, read_robot
from omniperception.sim import SimConfig

sys.path.insert(0, str(Path(__file__).parents[1]))
from own_robots import BIPED, BIPED_PRESET, HEXAPOD, write_preset

BLIND = ("perception=none", "lidar=none", "rewards=walk", "observations=walk")


def biped(folder, text=BIPED, **changes):
    (folder / "biped.xml").write_text(text)
    mounts = {name: Mount(**mount) for name, mount in BIPED_PRESET["mounts"].items()}
    return RobotConfig(**{**BIPED_PRESET, "mounts": mounts, "file": str(folder / "biped.xml"), **changes})


def world_of(robot, sensors=()):
    return build_world(robot, TerrainConfig(), ObstaclesConfig(), sensors)


@pytest.fixture
def world(tmp_path):
    return world_of(biped(tmp_path))


def test_physics_is_that_of_the_configuration_whatever_the_file_says(tmp_path):
    """Gravity, friction cone and contacts; the pair of the shanks, which self_collision does not name."""
    options = '<option gravity="0 0 -1" impratio="50" cone="elliptic"><flag contact="disable"/></option><worldbody>'
    feet = [f"{side}_shank_geom_1" for side in ("right", "left")]
    pair = f'<contact><pair geom1="{feet[0]}" geom2="{feet[1]}"/></contact></mujoco>'
    text = BIPED.replace("<worldbody>", options).replace("</mujoco>", pair)
    for foot in feet:
        text = text.replace('<geom type="box" size="0.06', f'<geom name="{foot}" type="box" size="0.06', 1)
    model, plain = world_of(biped(tmp_path, text)).model, world_of(biped(tmp_path)).model
    assert model.opt.gravity.tolist() == [0.0, 0.0, -9.81] and model.npair == 0
    for name in ("impratio", "cone", "disableflags", "solver"):
        assert getattr(model.opt, name) == getattr(plain.opt, name), name


def test_what_a_file_says_of_all_elements_is_not_said_of_those_of_the_simulation(tmp_path):
    """Actuators, ground and obstacles are as beside any other robot; the robot's own geoms are as their file says."""
    said = (
        '<default><geom margin="0.02" solref="0.1 1" rgba="1 0 0 1" condim="6" friction="9 9 9" priority="2"/>'
        '<mesh scale="0.001 0.001 0.001"/><motor ctrllimited="true" ctrlrange="-1 1" gear="50"/>'
        '<general damping="2" armature="0.3"/>'
        '<pair margin="0.3"/></default><worldbody>'
    )

    groups = {"box": ObstacleGroup("box", 1, [[0.2, 0.3]] * 3)}
    groups["rock"] = ObstacleGroup("mesh", 1, [[0.2, 0.3]] * 3, file="rock")
    obstacles, models = ObstaclesConfig(groups=groups), []
    for text in (BIPED, BIPED.replace("<worldbody>", said, 1)):
        models.append(build_world(biped(tmp_path, text), TerrainConfig(), obstacles).model)
    plain, model = models
    names = [name for name in dir(plain) if name.startswith("actuator_")] + ["dof_M0", "dof_armature", "dof_damping"]
    assert len(names) > 20
    for name in names:
        np.testing.assert_array_equal(getattr(model, name), getattr(plain, name), name)
    own = model.geom_bodyid == 0
    own |= model.body_mocapid[model.geom_bodyid] >= 0
    assert own.sum() == 3
    for name in ("margin", "solref", "condim", "friction", "priority", "rbound", "size"):
        np.testing.assert_array_equal(getattr(model, f"geom_{name}")[own], getattr(plain, f"geom_{name}")[own], name)
    assert (model.geom_rgba[~own] == (1, 0, 0, 1)).all() and not (model.geom_rgba[own] == (1, 0, 0, 1)).all(1).any()


def test_a_file_may_say_that_limits_have_to_be_said(tmp_path):
    said = BIPED.replace("<worldbody>", '<compiler autolimits="false"/><worldbody>', 1)
    model = world_of(biped(tmp_path, said.replace(" range=", ' limited="true" range='))).model
    np.testing.assert_array_equal(model.actuator_forcerange, world_of(biped(tmp_path)).model.actuator_forcerange)


def test_heights_are_those_of_an_upright_base_however_the_file_has_it(tmp_path):
    straight = biped(tmp_path)
    (tmp_path / "leaning").mkdir()
    leaning = biped(tmp_path / "leaning", BIPED.replace('<body name="torso"', '<body name="torso" euler="0 90 0"', 1))
    assert "euler" in Path(leaning.file).read_text()
    assert leaning.height_of("left_shank") == pytest.approx(straight.height_of("left_shank"))


# --- joints in any order, and passive ones ----------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_states_are_those_of_the_joints_by_name_and_passive_joints_start_in_the_default_pose(world, engine):
    sim = simulator(world, engine)
    angles = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5])
    qpos = torch.cat((torch.tensor([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]), angles)).repeat(2, 1)
    qvel = torch.cat((torch.zeros(6), 10 * angles)).repeat(2, 1)
    sim.reset(torch.arange(2), qpos, qvel)
    for name, angle in zip(world.robot.joints, angles.tolist(), strict=True):
        joint = world.model.joint(name)
        assert sim.qpos[1, int(joint.qposadr[0])] == pytest.approx(angle)
        assert sim.qvel[1, int(joint.dofadr[0])] == pytest.approx(10 * angle)
    assert sim.qpos[0, int(world.model.joint("tail").qposadr[0])] == pytest.approx(0.3)
    torch.testing.assert_close(sim.robot_state()[0], qpos)
    torch.testing.assert_close(sim.robot_state()[1], qvel)


def simulator(world, engine):
    if engine == "mujoco":
        return SimConfig(num_threads=1).build(world, 2)
    from omniperception.sim.mujoco_warp import MujocoWarpConfig

    return MujocoWarpConfig(device="cpu").build(world, 2)


def test_a_robot_with_passive_joints_and_unnamed_geoms_steps_with_late_measurements(make_env, tmp_path):
    """Actions, observations and torques are of the five driven joints; the tail swings by itself."""
    folder = write_preset(tmp_path)
    late = ("randomization=paper", "randomization.payload_mass=null", "randomization.added_mass=null")
    env = make_env(folder, "robot=biped", *BLIND, *late, num_envs=3)
    tail = int(env.world.model.joint("tail").qposadr[0])
    before = env.sim.qpos[:, tail].clone()
    for _ in range(5):
        _, reward, _, _ = env.step(torch.zeros(3, 5))
    assert torch.isfinite(reward).all() and (env.sim.qpos[:, tail] - before).abs().min() > 1e-3
    assert env.state.joint_torque.shape == env.state.measured.joint_pos.shape == (3, 5)


# --- what touches -----------------------------------------------------------------------------------------------------


def test_only_geoms_that_collide_in_the_file_touch_the_ground(world):
    """The visual box of 0.6 m would lie in the ground when the feet stand on it."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.rest_positions
    data.qpos[2:7] = 0.4995, 1, 0, 0, 0
    for name in ("left_hip", "left_knee", "right_hip", "right_knee"):
        data.joint(name).qpos = 0.0
    mujoco.mj_forward(world.model, data)
    touching = {world.model.geom(int(k)).name for k in data.contact.geom.flatten()}
    assert touching == {"ground", "left_shank_geom_1", "right_shank_geom_1"}
    data.qpos[2] = 0.2
    mujoco.mj_forward(world.model, data)
    touching = {world.model.geom(int(k)).name for k in data.contact.geom.flatten()}
    assert not any("torso_geom_0" in name for name in touching)


def test_geoms_that_nobody_needs_are_not_compiled_and_the_masses_stay(tmp_path):
    model = biped(tmp_path).compiled()
    assert [model.geom(k).name for k in range(model.ngeom)].count("torso_geom_0") == 0
    assert model.body_mass.sum() == pytest.approx(parse(tmp_path / "biped.xml").compile().body_mass.sum())
    weighs = BIPED.replace('class="look" type="box"', 'contype="0" conaffinity="0" mass="2" type="box"')
    assert biped(tmp_path, weighs).compiled().body_mass.sum() == pytest.approx(model.body_mass.sum() + 2)


def test_the_robot_touches_itself_where_the_preset_says_so(tmp_path):
    """Knees bent inwards until the shanks cross; without the pair they pass through each other."""
    for pairs, expected in (((), False), ((("left_shank", "right_shank"),), True)):
        crossing = BIPED.replace('pos="0 0.07 -0.08"', 'pos="0 -0.05 -0.08"')
        world = world_of(biped(tmp_path, crossing, self_collision=pairs))
        data = mujoco.MjData(world.model)
        data.qpos[:] = world.rest_positions
        data.qpos[2] = 2.0
        mujoco.mj_forward(world.model, data)
        assert bool(data.ncon) == expected
    with pytest.raises(ValueError, match="robot.self_collision names arm, which .* known: torso, tail"):
        world_of(biped(tmp_path, self_collision=(("arm", "torso"),)))


# --- what rays hit ----------------------------------------------------------------------------------------------------


def test_unnamed_geoms_are_in_the_scan_and_can_be_left_out_one_by_one(world):
    """Nine geoms of the robot collide, none of which has a name in the file."""
    shapes = ray_shapes(world)
    own = [name for name in shapes.geom_names if name != "ground"]
    assert len(own) == len(set(own)) == 9 and "" not in own
    assert set(ray_shapes(world, ("head_geom_0",)).geom_names) == {*shapes.geom_names} - {"head_geom_0"}


def test_rays_hit_the_groups_that_the_preset_names(tmp_path):
    """A ray from ahead at the torso's height meets the visual box at x = 0.3, or the torso's at 0.05."""
    for groups, expected in ((None, 0.05), ((2,), 0.3)):
        world = world_of(biped(tmp_path, ray_groups=groups))
        shapes = ray_shapes(world)
        assert ("torso_geom_0" in shapes.geom_names) == (groups is not None)
        data, geom = mujoco.MjData(world.model), np.zeros(1, np.int32)
        data.qpos[:] = world.rest_positions
        data.qpos[2] = 2.0
        mujoco.mj_forward(world.model, data)
        seen = np.zeros(6, np.uint8)
        seen[[3] if groups is None else list(groups)] = 1
        origin, ahead = np.array([2.0, 0.0, 2.0]), np.array([-1.0, 0.0, 0.0])
        distance = mujoco.mj_ray(world.model, data, origin, ahead, seen, 1, -1, geom)
        assert 2.0 - distance == pytest.approx(expected)
        assert world.model.geom(int(geom[0])).name in shapes.geom_names


# --- gains ------------------------------------------------------------------------------------------------------------


def test_each_joint_has_gains_and_limits_of_its_own(world):
    """tau = kp (target - q) - kv qdot within the joint's own limit; the controls are in the order of robot.joints."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.rest_positions
    data.qvel[6:] = 0.5
    data.ctrl[:] = world.robot.by_joint("default_joint_pos")
    data.ctrl[1] += 0.1
    data.ctrl[2] += 3.0
    mujoco.mj_forward(world.model, data)
    kv = world.robot.kv
    expected = [-0.5 * kv[name] for name in world.robot.joints]
    expected[1] += 30 * 0.1
    expected[2] = 2.0
    np.testing.assert_allclose(data.actuator_force, expected, atol=1e-9)


def test_friction_armature_and_damping_are_the_files_unless_given(tmp_path):
    def of(model, name):
        dof = int(model.joint(name).dofadr[0])
        return model.dof_frictionloss[dof], model.dof_armature[dof], model.dof_damping[dof]

    joints = BIPED_PRESET["joints"]
    plain = biped(tmp_path).compiled()
    assert of(plain, "left_hip") == (0.02, 0.01, 0.1) and of(plain, "neck") == (0.0, 0.005, 0.1)
    armature = {name: 0.03 + 0.01 * k for k, name in enumerate(joints)}
    given = biped(tmp_path, frictionloss=0.2, armature=armature, damping=0.0).compiled()
    assert of(given, "left_hip") == (0.2, 0.03, 0.0) and of(given, "neck") == pytest.approx((0.2, 0.05, 0.0))
    assert of(given, "tail") == (0.3, 0.002, 0.05)  # it is not of robot.joints


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": {"left_hip": 1.0}}, "robot.kp must name exactly robot.joints, or be a number; differing: .*neck"),
        ({"default_joint_pos": {"neck": 0.0}}, "robot.default_joint_pos must name all of robot.joints; missing:"),
        ({"kp": {**BIPED_PRESET["kp"], "neck": 0.0}}, r"robot.kp.neck=0.0 must be positive"),
    ],
)
def test_numbers_by_joint_must_be_of_the_joints(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        biped(tmp_path, **change)


def test_a_pose_beyond_a_joints_stop_is_refused(tmp_path):
    pose = {**BIPED_PRESET["default_joint_pos"], "left_knee": -0.2}
    with pytest.raises(ValueError, match=r"robot.default_joint_pos.left_knee=-0.2 is outside its range .* -0.1 to 2.2"):
        world_of(biped(tmp_path, default_joint_pos=pose))


# --- joints that are held ---------------------------------------------------------------------------------------------


def placed(robot, angles):
    """The robot with joints at these angles, its base where the file has it."""
    model = robot.compiled()
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(name).qpos = angle
    mujoco.mj_forward(model, data)
    return model, data


def test_links_of_locked_joints_are_where_the_joints_at_these_angles_put_them(tmp_path):
    """Against the same file whose joints turn, by MuJoCo's kinematics, through links that follow one another."""
    held = {"left_hip": -0.4, "left_knee": 0.7, "tail": -0.9}
    others = {"neck": 0.3, "right_hip": -0.2, "right_knee": 0.5}
    locked, free = biped(tmp_path, locked=held), biped(tmp_path)
    assert locked.joints == ("neck", "right_hip", "right_knee") and set(locked.kp) == set(others)
    found, turning = placed(locked, others), placed(free, held | others)
    assert found[0].nv == turning[0].nv - 3 and found[0].nu == 3
    for body in (turning[0].body(k).name for k in range(1, turning[0].nbody)):
        np.testing.assert_allclose(found[1].body(body).xpos, turning[1].body(body).xpos, atol=1e-12)
        np.testing.assert_allclose(found[1].body(body).xmat, turning[1].body(body).xmat, atol=1e-12)
    np.testing.assert_allclose(found[1].subtree_com[1], turning[1].subtree_com[1], atol=1e-12)
    world_of(locked)


def test_a_locked_joint_of_a_urdf_carries_its_mounts(tmp_path):
    """Its link is fused into the one before, and is still found: a foot 0.21 m along a lower leg that is held."""
    robot = on_six_legs(tmp_path)
    own = {"joints": ("r0_lift",), "default_joint_pos": {"r0_lift": 0.0}}
    locked = dataclasses.replace(robot, locked={"l0_lift": 0.5}, **own)
    mount = Mount(pos=(0.01, 0.02, 0.03), body="l0_foot")
    place = locked.place(mount)
    _, data = placed(robot, {"l0_lift": 0.5})
    link = data.body("l0_lower")
    carrier = data.body(place.body)
    at = link.xpos + link.xmat.reshape(3, 3) @ (np.array((0.0, 0.0, -0.21)) + mount.pos)
    expected = carrier.xmat.reshape(3, 3).T @ (at - carrier.xpos)
    np.testing.assert_allclose(place.pos, expected, atol=1e-9)


def test_locked_joints_in_a_chain_of_a_urdf_and_on_one_link_in_a_frame_and_a_slide(tmp_path):
    """Against the same files with joints that turn: where all geoms are. Fixed links are fused in the URDF's model."""
    robot = on_six_legs(tmp_path)
    own = {"joints": ("r0_lift",), "default_joint_pos": {"r0_lift": 0.0}}
    held = {"l0_swing": 0.3, "l0_lift": -0.7}
    chain = placed(dataclasses.replace(robot, locked=held, **own), {}), placed(robot, held)
    text = BIPED.replace(
        '<body name="left_thigh" pos="0 0.07 -0.08">', '<frame euler="0 0.3 0"><body name="left_thigh">'
    )
    text = text.replace(
        '<joint name="left_knee"', '<joint name="twist" axis="1 0 1" pos="0 0.02 0"/><joint name="left_knee"'
    )
    text = text.replace('<joint name="tail" axis', '<joint name="tail" type="slide" ref="0.1" axis')
    i = text.index('<body name="head"')
    text = text[:i].rstrip() + "</frame>" + text[i:]
    held = {"left_knee": 0.9, "left_hip": -0.6, "tail": 0.3}
    whole = placed(biped(tmp_path, text), held | {"twist": 0.4})
    link = placed(biped(tmp_path, text, locked=held), {"twist": 0.4}), whole
    for ((model, data), (free, turned)), count in ((chain, 2), (link, 3)):
        assert free.nv - model.nv == count
        for geom in (free.geom(k).name for k in range(free.ngeom)):
            np.testing.assert_allclose(data.geom(geom).xpos, turned.geom(geom).xpos, atol=1e-9, err_msg=geom)
            np.testing.assert_allclose(data.geom(geom).xmat, turned.geom(geom).xmat, atol=1e-9, err_msg=geom)


@pytest.mark.parametrize(
    ("locked", "message"),
    [
        ({"tail": 1.5}, "robot.locked.tail=1.5 is outside its range in .*, -1 to 1"),
    ],
)
def test_joints_that_cannot_be_locked_are_named(tmp_path, locked, message):
    with pytest.raises(ValueError, match=message):
        world_of(biped(tmp_path, locked={"neck": 0.0, **locked}))


# --- feet of several geoms --------------------------------------------------------------------------------------------


def test_a_foot_of_several_geoms_has_their_forces_and_the_mean_of_their_centres(make_env, tmp_path):
    feet = [["left_shank_geom_1", "left_shank_geom_0"], ["right_shank_geom_1", "right_shank_geom_0"]]
    folder = write_preset(tmp_path, preset={**BIPED_PRESET, "foot_geoms": feet})
    env = make_env(
        folder,
        "robot=biped",
        *BLIND,
        "+rewards.terms.foot_air_time={weight: 1.0, target: 0.3, min_speed: 0.1}",
        num_envs=1,
    )
    for _ in range(5):
        env.step(torch.zeros(1, 5))
    state, model = env.state, env.world.model
    assert state.foot_force.shape == state.foot_pos_w.shape == (1, 2, 3)
    data = mujoco.MjData(model)
    data.qpos[:] = env.sim.qpos[0].numpy()
    mujoco.mj_kinematics(model, data)
    for k, foot in enumerate(feet):
        centre = np.mean([data.geom(name).xpos for name in foot], 0)
        np.testing.assert_allclose(state.foot_pos_w[0, k].numpy(), centre, atol=1e-5)
    single = env.sim.contact_sensor("foot_force").view(1, 4, 3)
    torch.testing.assert_close(state.foot_force[:, 0], single[:, 0] + single[:, 1])


# --- URDF -------------------------------------------------------------------------------------------------------------


def hexapod(folder, text=HEXAPOD):
    path = folder / "hexapod.urdf"
    path.write_text(text)
    return path


def on_six_legs(folder, **changes):
    """A preset of the hexapod with one actuated joint."""
    numbers = dict.fromkeys(("kp", "kv", "torque_limits", "action_scale"), 1.0) | changes
    own = {"base": "base_link", "joints": ("l0_lift",), "default_joint_pos": {"l0_lift": 0.0}}
    return dataclasses.replace(biped(folder), file=str(hexapod(folder)), **own, **numbers)


def test_a_urdf_floats_keeps_its_feet_and_its_mass(tmp_path):
    model = read_robot(hexapod(tmp_path)).compile()
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and model.body(int(model.jnt_bodyid[0])).name == "base_link"
    assert model.nbody == 1 + 1 + 12 and model.body_mass.sum() == pytest.approx(6.9)
    names = [model.geom(k).name for k in range(model.ngeom)]
    assert {f"{side}{k}_foot_geom_0" for side in "lr" for k in range(3)} < set(names) and "" not in names
    assert model.joint("l0_swing").range.tolist() == [-0.6, 0.6]
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=10)
    assert data.qpos[2] < -1e-4  # it falls: the base is not fused with the world


def test_meshes_of_a_urdf_are_found_beside_it_and_in_its_package(tmp_path):
    folder = tmp_path / "ws" / "spider" / "urdf"
    folder.mkdir(parents=True)
    meshes = folder.parent / "meshes"
    meshes.mkdir()
    (meshes / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    box = '<box size="0.4 0.2 0.08"/>'
    for name in ("package://spider/meshes/t.obj", "../meshes/t.obj", f"file://{meshes / 't.obj'}"):
        model = read_robot(hexapod(folder, HEXAPOD.replace(box, f'<mesh filename="{name}"/>'))).compile()
        assert model.nmesh == 1 and model.geom_type[0] == mujoco.mjtGeom.mjGEOM_MESH


def test_a_urdf_may_leave_out_the_end_of_a_range_that_is_0(tmp_path):
    """MuJoCo takes a range of one end for none."""
    one = HEXAPOD.replace('lower="-1.2" upper="1.2"', 'upper="1.2"', 1)
    model = read_robot(hexapod(tmp_path, one)).compile()
    assert model.joint("l0_lift").range.tolist() == [0.0, 1.2] and model.jnt_limited[model.joint("l0_lift").id]


def test_torque_limits_are_the_presets_where_the_files_are_lower(tmp_path):
    """An effort of 15 N m in the URDF, 20 N m in the preset."""
    robot = on_six_legs(tmp_path, torque_limits=20.0, kp=1000.0)
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[model.joint("l0_lift").dofadr[0]] == pytest.approx(20.0)


def test_meshes_of_the_same_name_in_two_folders_are_told_apart(tmp_path):
    """The one that is touched is half as large in all directions."""
    corners = "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    for folder, size in (("visual", 1.0), ("collision", 0.5)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "trunk.obj").write_text(corners.format(size))
    text = HEXAPOD
    for folder in ("visual", "collision"):
        shape = f'<{folder}><geometry><mesh filename="{folder}/trunk.obj"/></geometry></{folder}>'
        text = text.replace('<link name="trunk">', f'<link name="trunk">{shape}', 1)
    model = read_robot(hexapod(tmp_path, text)).compile()
    spans = {}
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        mesh = model.geom_dataid[geom]
        first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = model.mesh_vert[first : first + number]
        spans[bool(model.geom_contype[geom])] = np.linalg.norm(np.ptp(vertices, axis=0))
    assert spans[False] == pytest.approx(2 * spans[True], rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('lower="-1.2" upper="1.2"', 'lower="0" upper="0"', "joint l0_lift has limits from 0 to 0; give it a range"),
        ('<box size="0.4 0.2 0.08"/>', '<mesh filename="package://a/b.stl"/>', "mesh package://a/b.stl is missing;"),
        ('<box size="0.4 0.2 0.08"/>', '<mesh filename="bad.dae"/>', "mesh bad.dae is missing"),
        ('name="l1_lift"', 'name="l0_lift"', "repeated name.*rename one of the two"),
        ("</robot>", "", "is not XML"),
    ],
)
def test_a_urdf_that_cannot_be_right_is_refused_in_one_line(tmp_path, old, new, message):
    path = hexapod(tmp_path, HEXAPOD.replace(old, new))
    with pytest.raises(ValueError, match=message) as error:
        read_robot(path).compile()
    assert str(error.value).startswith(f"robot.file={path}") and "\n" not in str(error.value)


TENDON = '<tendon><fixed name="rope"><joint joint="tail" coef="1"/></fixed></tendon></mujoco>'
LOOP = '<equality><connect body1="head" body2="tail" anchor="0 0 0"/></equality></mujoco>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<freejoint/>", "", "no body floats .* put <freejoint/> into the body of the base: torso"),
        ("</mujoco>", LOOP, "the connect of head and tail closes a loop"),
        ("<worldbody>", '<worldbody><geom name="floor" type="plane" size="1 1 1"/>', "geom floor stands in the world"),
        (
            'size="0.01" mass="0.1"',
            'size="0.01" mass="0"',
            "mass and inertia of moving bodies .*tail.*; give that link",
        ),
        ('range="-1 1"', 'range="0 0"', "joint tail has a range from 0 to 0, which MuJoCo takes for no limit"),
        ('<geom type="sphere" size="0.05"', '<geom type="mesh" mesh="gone"', "gone.stl.*; put the mesh where"),
        ("<worldbody>", '<compiler settotalmass="7"/><worldbody>', "settotalmass> would scale .* give its links"),
    ],
)
def test_an_mjcf_that_cannot_be_right_is_refused_in_one_line(tmp_path, old, new, message):
    text = BIPED.replace(old, new, 1)
    if "gone" in new:
        text = text.replace("</worldbody>", '</worldbody><asset><mesh file="gone.stl"/></asset>')
    with pytest.raises(ValueError, match=message) as error:
        world_of(biped(tmp_path, text))
    assert "biped.xml" in str(error.value) and "\n" not in str(error.value)


# --- mounts -----------------------------------------------------------------------------------------------------------


def test_a_mount_on_a_fixed_link_is_one_on_the_link_that_carries_it(tmp_path):
    """The lidar's link is fused into the base 0.15 m ahead and 0.1 m up, pitched by 0.2 rad; 0.1 m along its own x."""
    robot = on_six_legs(tmp_path)
    place = robot.place(Mount(pos=(0.1, 0.0, 0.0), rpy=(0.0, 0.3, 0.0), body="lidar"))
    assert place.body is None
    np.testing.assert_allclose(place.pos, [0.15 + 0.1 * np.cos(0.2), 0, 0.1 - 0.1 * np.sin(0.2)], atol=1e-9)
    np.testing.assert_allclose(place.quat, [np.cos(0.25), 0, np.sin(0.25), 0], atol=1e-9)  # 0.2 + 0.3 rad of pitch
    moving = robot.place(Mount(pos=(0.0, 0.0, 0.0), body="l0_foot"))
    assert moving.body == "l0_lower"
    np.testing.assert_allclose(moving.pos, [0, 0, -0.21], atol=1e-9)
    with pytest.raises(ValueError, match="body=nose is no link of .* known: base_link, .*lidar"):
        robot.place(Mount(pos=(0, 0, 0), body="nose"))


def test_a_lidar_on_a_turning_head_sees_from_the_head(make_env, tmp_path):
    """Each measured range is mj_ray's from the eyes' pose, and sectors count from the base, with a turned neck."""
    folder = write_preset(tmp_path)
    task = ("robot=biped", "lidar.mount=eyes", "lidar.num_rays=200", "rewards=paper", "obstacles=static")
    env = make_env(folder, *task, "perception=fps_mlp", num_envs=1)
    sensing, model = env.sensing, env.world.model
    assert sensing.carrier != sensing.base and sensing.config.mount_body == "head"
    qpos = env.sim.qpos
    qpos[0, int(model.joint("neck").qposadr[0])] = 1.2
    qpos[0, 3:7] = torch.tensor([0.9, 0.1, -0.1, 0.4], dtype=qpos.dtype) / np.linalg.norm([0.9, 0.1, -0.1, 0.4])
    qpos[0, 2] = 1.0
    parts = env.sim.mocap_pos.shape[1]
    angle = torch.arange(parts) * 2 * np.pi / parts
    env.sim.mocap_pos[0, :, 0], env.sim.mocap_pos[0, :, 1] = qpos[0, 0] + 2 * angle.cos(), qpos[0, 1] + 2 * angle.sin()
    env.sim.mocap_pos[0, :, 2] = 1.0
    env.state.invalidate()
    sensing.take_frame(0.1, env.state.measured.base_quat_w, env.timer)
    model.geom_size[:] = env.sim.model_field("geom_size")[0].numpy()
    data = mujoco.MjData(model)
    data.qpos[:], data.mocap_pos[:] = qpos[0].numpy(), env.sim.mocap_pos[0].numpy()
    data.mocap_quat[:] = env.sim.mocap_quat[0].numpy()
    mujoco.mj_forward(model, data)
    mount = env.robot.mounts["eyes"]
    link = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "eyes")
    own, turn = np.zeros(9), np.zeros(4)
    mujoco.mju_euler2Quat(turn, np.array(mount.rpy), "XYZ")
    mujoco.mju_quat2Mat(own, turn)
    frame = data.xmat[link].reshape(3, 3) @ own.reshape(3, 3)
    origin = data.xpos[link] + data.xmat[link].reshape(3, 3) @ np.array(mount.pos)
    lidar_frame, nearest = sensing.lidar.frame, np.full(env.avoidance.sector_distance.shape[1], np.inf)
    base = data.body("torso")
    yaw = np.arctan2(base.xmat.reshape(3, 3)[1, 0], base.xmat.reshape(3, 3)[0, 0])
    model.geom("head_geom_0").group[:] = 5
    groups, geom, hits = np.array([1, 1, 1, 1, 1, 0], np.uint8), np.zeros(1, np.int32), 0
    for direction, found in zip(lidar_frame.directions_s[0].numpy(), lidar_frame.true_ranges[0].tolist(), strict=True):
        ray = frame @ direction.astype(np.float64)
        distance = mujoco.mj_ray(model, data, origin, ray, groups, 1, -1, geom)
        if 0.2 < distance < 5.9:
            assert found == pytest.approx(distance, abs=1e-3)
            if model.geom(int(geom[0])).name.startswith("obstacle"):
                point = (origin + distance * ray - base.xpos)[:2]
                azimuth = np.arctan2(point[1], point[0]) - yaw
                sector = int(((azimuth + np.pi) % (2 * np.pi)) / (2 * np.pi) * len(nearest))
                nearest[sector] = min(nearest[sector], np.linalg.norm(point))
                hits += 1
    assert hits > 5
    found = env.avoidance.sector_distance[0].numpy()
    seen = np.isfinite(nearest)
    np.testing.assert_allclose(found[seen], nearest[seen], atol=2e-3)
    assert (found[~seen] == sensing.config.max_range).all()


def test_the_ground_is_looked_up_and_falls_are_told_by_the_robots_own_size(make_env, tmp_path):
    folder = write_preset(tmp_path)
    env = make_env(folder, "robot=biped", *BLIND, "terrain=rough", num_envs=1)
    assert env.config.terminations.min_base_height == 0.3
    assert env.state._height_lookup._footprint.abs().amax(0).tolist() == pytest.approx([0.05, 0.07])
