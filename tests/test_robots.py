"""Presets guessed from files of robots, and what is said about how they stand."""

import dataclasses
import math
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from omniperception import build, config
from omniperception.commands import main
from omniperception.commands.robot_check import NO_TASK
from omniperception.robots.body import Body
from omniperception.robots.guess import GUESSED, SURE, Options, guess
from omniperception.robots.preset import text_of
from omniperception.robots.stand import flat_world, reached_limits, stand
from omniperception.scene import RobotConfig
from omniperception.scene.robot_file import compile_robot, read_robot
from omniperception.schema import make

sys.path.insert(0, str(Path(__file__).parent))
from own_robots import BIPED, HEXAPOD

LEGS = ("left_hip", "left_knee", "right_hip", "right_knee")
DATA = Path(__file__).parent / "data"
GO2 = Path(build.__file__).parent / "scene" / "assets" / "go2.xml"


@pytest.fixture(scope="module")
def guesses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    (folder / "biped.xml").write_text(BIPED)
    (folder / "hexapod.urdf").write_text(HEXAPOD)
    options = {"biped.xml": Options(joints=(*LEGS, "neck"), lidar="head")}
    return {
        path.stem: guess(path, str(path), options.get(path.name, Options()))
        for path in (folder / "biped.xml", folder / "hexapod.urdf", GO2)
    }


def how_sure(found, key):
    return next(finding.how_sure for finding in found.findings if key in finding.key.split(", "))


def test_the_go2s_own_file_gives_nearly_its_preset(guesses):
    """Its preset is by hand: feet, links, 0.33 m, kp 25, action scale 0.25, falls at 0.15 m, hips 0.2 m ahead."""
    found = guesses["go2"].preset
    by_hand = yaml.safe_load((config.CONFIG_DIR / "robot" / "go2.yaml").read_text())
    assert found["base"] == "base" and found["joints"] == by_hand["joints"]
    assert set(found["foot_geoms"]) == set(by_hand["foot_geoms"])
    assert set(found["penalized_geoms"]) == set(by_hand["penalized_geoms"])
    assert found["base_height"] == pytest.approx(0.33, abs=0.03) and found["min_base_height"] == pytest.approx(
        0.15, abs=0.01
    )
    assert found["footprint"] == pytest.approx([0.19, 0.14], abs=0.02)
    for name, angle in found["default_joint_pos"].items():
        assert angle == pytest.approx(by_hand["default_joint_pos"][name], abs=0.3), name
    robot = make(RobotConfig, found, "robot")
    assert all(20 < kp < 60 for kp in robot.by_joint("kp")) and all(
        0.1 < x <= 0.3 for x in robot.by_joint("action_scale")
    )
    assert all(15 < limit < 50 for limit in robot.by_joint("torque_limits"))
    assert how_sure(guesses["go2"], "torque_limits") == GUESSED and how_sure(guesses["go2"], "armature") == SURE
    assert guesses["go2"].standing.steady and any("6 pairs of joints" in note for note in guesses["go2"].notes)


def test_the_pose_is_its_own_mirror_image_and_the_height_that_of_its_feet(guesses):
    for found in guesses.values():
        robot = make(RobotConfig, found.preset, "robot")
        data = mujoco.MjData(world_model := robot.compiled())
        data.qpos[:7] = 0, 0, robot.base_height, 1, 0, 0, 0
        for name, angle in robot.default_joint_pos.items():
            data.joint(name).qpos = angle
        mujoco.mj_forward(world_model, data)
        body = Body(world_model)
        body.place({world_model.joint(name).id: angle for name, angle in robot.default_joint_pos.items()})
        assert robot.base_height + body.ground() == pytest.approx(0.0, abs=1e-3)
    pose = guesses["go2"].preset["default_joint_pos"]
    assert pose["FL_hip_joint"] == -pose["FR_hip_joint"] and pose["RL_calf_joint"] == pose["RR_calf_joint"]


def test_neighbouring_feet_step_in_turn(guesses):
    """A walk on two, a trot on four, tripods on six; the Go2's as in its preset."""
    expected = {
        "biped": {"le": 0.0, "ri": 0.5},
        "go2": {"FL": 0.0, "FR": 0.5, "RL": 0.5, "RR": 0.0},
        "hexapod": {f"{side}{k}": 0.5 * ((k + (side == "r")) % 2) for side in "lr" for k in range(3)},
    }
    for name, offsets in expected.items():
        preset = guesses[name].preset
        names = [foot if isinstance(foot, str) else foot[0] for foot in preset["foot_geoms"]]
        found = {foot[:2]: offset for foot, offset in zip(names, preset["gait"]["offsets"], strict=True)}
        assert found == offsets, name
    assert guesses["go2"].preset["gait"]["frequency"] == pytest.approx(2.5, abs=0.11)
    assert guesses["go2"].preset["gait"]["foot_height"] == pytest.approx(0.09, abs=0.01)


def test_velocities_grow_with_the_root_of_the_height(guesses):
    """0.45 of the root of g times the height on two feet, 1.1 on more."""
    for name, share, lift in (("biped", 0.45, 1.0), ("go2", 1.1, 1.6), ("hexapod", 1.1, 1.6)):
        preset = guesses[name].preset
        gait, natural = preset["gait"], math.sqrt(9.81 * preset["base_height"])
        assert gait["lift"] == lift and gait["lin_vel_x"][1] == pytest.approx(share * natural, abs=0.051), name
        assert gait["lin_vel_x"][0] < 0 and gait["lin_vel_y"][0] == -gait["lin_vel_y"][1] < 0, name
    assert guesses["go2"].preset["gait"]["lin_vel_x"] == pytest.approx([-1.0, 2.0], abs=0.11)


def test_flat_feet_stand_flat_whose_knees_bend_one_way():
    """The knees' range begins at 0. Soles are 3 cm thick boxes; a foot's centre rises by 0.1 m from 1.5 cm."""
    found = guess(DATA / "strider.urdf", str(DATA / "strider.urdf")).preset
    angles = found["default_joint_pos"]
    assert angles["left_knee"] > 0.3
    assert sum(angles[f"left_{joint}"] for joint in ("hip_pitch", "knee", "ankle")) == pytest.approx(0.0, abs=0.01)
    assert found["gait"]["foot_height"] == pytest.approx(0.115, abs=0.002)


def test_a_urdf_says_its_torques_and_where_its_lidar_is(guesses):
    found = guesses["hexapod"]
    limits = found.preset["torque_limits"]
    assert limits["l0_swing"] == 12.0 and limits["r2_lift"] == 15.0 and how_sure(found, "torque_limits") == SURE
    assert found.preset["mounts"]["head"] == {"pos": [0.0, 0.0, 0.0], "body": "lidar"}
    assert len(found.preset["foot_geoms"]) == 6 and found.preset["base"] == "base_link"
    assert found.standing.steady and found.standing.height == pytest.approx(0.23, abs=0.01)


def test_passive_joints_and_a_lidar_on_a_link_as_asked_for(guesses):
    found = guesses["biped"]
    assert found.preset["joints"] == [*LEGS, "neck"] and "tail" not in found.preset["default_joint_pos"]
    assert len(found.preset["foot_geoms"]) == 2 and found.preset["mounts"]["back"]["body"] == "head"
    assert any("2 pairs of joints" in note for note in found.notes)


def test_actuators_of_the_file_say_which_joints_are_driven(tmp_path):
    (tmp_path / "biped.xml").write_text(
        BIPED.replace('<motor joint="tail"/>', "".join(f'<motor joint="{x}" ctrlrange="-9 9" gear="2"/>' for x in LEGS))
    )
    found = guess(tmp_path / "biped.xml", str(tmp_path / "biped.xml"), Options(self_collision=False))
    assert found.preset["joints"] == list(LEGS) and found.preset["torque_limits"] == 18.0
    assert found.preset["self_collision"] == []


def test_a_joint_that_follows_another_is_passive(tmp_path):
    """`<mimic>`: the leg that follows, which nothing drives, bends as the one that is pushed does."""
    path, driven = tmp_path / "hexapod.urdf", '<joint name="l1_lift" type="revolute">'
    assert HEXAPOD.count(driven) == 1
    path.write_text(HEXAPOD.replace(driven, driven + '<mimic joint="l0_lift"/>'))
    found = guess(path, str(path))
    assert "l1_lift" not in found.preset["joints"] and len(found.preset["joints"]) == 11
    assert "1 follow others" in next(finding.why for finding in found.findings if finding.key == "joints")
    model = compile_robot(read_robot(path), path)
    data, (first, second) = mujoco.MjData(model), (model.joint(f"l{k}_lift") for k in range(2))
    data.qfrc_applied[first.dofadr[0]] = 5.0
    for _ in range(100):
        mujoco.mj_step(model, data)
    angles = data.qpos[[first.qposadr[0], second.qposadr[0]]]
    assert angles[0] > 0.1 and angles[1] == pytest.approx(angles[0], abs=0.02)


def test_gains_are_a_spring_of_the_asked_frequency_where_nothing_else_counts(guesses):
    """The neck carries a head of 0.5 kg on its own axis: kp = I (2 pi f)^2, kv = 2 zeta sqrt(kp I), and as many times
    that, and its root, as the robot needs to stand."""
    preset, notes = guesses["biped"].preset, " ".join(guesses["biped"].notes)
    stiffer = float(notes.partition("gains are ")[2].split()[0])
    robot = make(RobotConfig, preset, "robot")
    model = robot.compiled()
    data = mujoco.MjData(model)
    data.qpos[:7] = 0, 0, 1, 1, 0, 0, 0
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    neck = int(model.joint("neck").dofadr[0])
    load = 2 * 9.81 * 0.5 * 0.05  # of a head 0.05 m above the joint
    kp = max(full[neck, neck] * (2 * math.pi * 2.0) ** 2, load)
    assert stiffer == 3.0 and preset["kp"]["neck"] == pytest.approx(stiffer * kp, rel=0.01)
    damping = 2 * 0.5 * math.sqrt(stiffer * kp * full[neck, neck])
    assert preset["kv"]["neck"] == pytest.approx(damping, rel=0.01)


def test_a_shank_that_ends_just_above_its_foots_ball_makes_no_sole(tmp_path):
    """Four legs of 0.2 + 0.2 m, bent to 80 % of their length, whose shanks' capsules end 7 mm above the balls'."""
    legs = "".join(
        f"""<body name="{name}" pos="{x} {y} 0"><joint name="{name}_hip" axis="0 1 0" range="-1.5 1.5"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/><body pos="0 0 -0.2">
        <joint name="{name}_knee" axis="0 1 0" range="-2.6 -0.1"/>
        <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.2" mass="0.2"/>
        <geom name="{name}_foot" type="sphere" size="0.022" pos="0 0 -0.2" mass="0.05"/></body></body>"""
        for name, x, y in (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("rl", -0.2, 0.1), ("rr", -0.2, -0.1))
    )
    trunk = '<freejoint/><geom type="box" size="0.25 0.1 0.05" mass="5"/>'
    path = tmp_path / "quad.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><body name="trunk">{trunk}{legs}</body></worldbody></mujoco>'
    )
    preset = guess(path, str(path), Options()).preset
    assert preset["base_height"] == pytest.approx(0.8 * 0.4 + 0.022, abs=0.015)
    assert preset["default_joint_pos"]["fl_knee"] == pytest.approx(-2 * math.acos(0.8), abs=0.1)
    assert preset["gait"]["foot_height"] == pytest.approx(0.022 + 0.2 * preset["base_height"], abs=0.01)


def test_lowest_points_and_bounds_are_those_of_the_geoms():
    """By hand: a box 0.1 x 0.2 x 0.3 turned by 45 deg about x reaches (0.2 + 0.3) / sqrt(2) down; a tilted capsule."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="base")
    body.add_freejoint()
    half = math.radians(45) / 2
    turn = [math.cos(half), math.sin(half), 0, 0]
    kinds = mujoco.mjtGeom
    body.add_geom(type=kinds.mjGEOM_BOX, size=[0.1, 0.2, 0.3], quat=turn)
    body.add_geom(type=kinds.mjGEOM_CAPSULE, size=[0.05, 0.4, 0], quat=turn)
    body.add_geom(type=kinds.mjGEOM_CYLINDER, size=[0.05, 0.4, 0], quat=turn)
    body.add_geom(type=kinds.mjGEOM_SPHERE, size=[0.07, 0, 0], pos=[0.5, 0, 0])
    found = Body(spec.compile())
    root = math.sqrt(0.5)
    expected = [-0.5 * root, -0.05 - 0.4 * root, -0.45 * root, -0.07]
    np.testing.assert_allclose([found.lowest(k) for k in range(4)], expected, atol=1e-9)
    low, high = found.bounds(range(4))
    np.testing.assert_allclose(low, [-0.1, -0.5 * root, -0.5 * root], atol=1e-9)
    np.testing.assert_allclose(high, [0.57, 0.5 * root, 0.5 * root], atol=1e-9)


# --- how it stands ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def go2():
    return build.assemble(config.compose([*NO_TASK, "lidar=none"])).env.robot


def test_the_weight_is_on_the_feet(go2):
    """15.2 kg times 9.81 m/s^2."""
    world = flat_world(go2)
    found, _ = stand(world)
    assert found.steady and all("ground" in pair for pair in found.contacts)
    weight = float(world.model.body_mass[1:].sum()) * 9.81
    assert sum(found.contacts.values()) == pytest.approx(weight, rel=0.02)


def test_a_robot_that_is_too_weak_does_not_stand(go2):
    weak = dataclasses.replace(go2, torque_limits=2.0)
    found, _ = stand(flat_world(weak))
    assert not found.steady and found.saturated


def test_a_joint_that_meets_another_link_or_is_too_soft_stops_short(go2):
    reach = reached_limits(flat_world(go2), seconds=0.6)
    assert set(reach) == set(go2.joints)
    low, high = reach["FL_hip_joint"]
    assert low == pytest.approx(-1.0472, abs=0.05) and high == pytest.approx(1.0472, abs=0.05)
    soft = dataclasses.replace(go2, kp={name: 1e-3 if name == "FL_hip_joint" else 25.0 for name in go2.joints})
    assert reached_limits(flat_world(soft), seconds=0.1)["FL_hip_joint"][1] < 0.5


# --- the commands -----------------------------------------------------------------------------------------------------


def test_a_preset_is_written_and_the_robot_checked_and_trained_with(tmp_path, monkeypatch, capsys, make_env):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spider.urdf").write_text(HEXAPOD)
    main(["robot-new", "spider.urdf", "out=robot"])
    said = capsys.readouterr().out
    assert "after 2 s it stands" in said and "written: robot/spider.yaml" in said and "torque_limits" in said
    text = (tmp_path / "robot" / "spider.yaml").read_text()
    assert text.startswith("# ") and max(map(len, text.splitlines())) <= 120
    assert yaml.safe_load(text)["file"] == "spider.urdf" and "# guess: springs of 2 Hz" in text
    with pytest.raises(SystemExit):
        main(["robot-new", "spider.urdf", "out=robot"])
    assert "robot/spider.yaml exists; give another name=..., or again=true" in capsys.readouterr().err
    main(["robot-check", "spider", "--config-dir", str(tmp_path), "out=seen", "seconds=0.5"])
    said = capsys.readouterr().out
    assert "after 0.5 s it stands" in said and "LiDAR on base_link" in said and "r2_lift" in said
    assert (tmp_path / "seen" / "picture.png").read_bytes()[:4] == b"\x89PNG"
    env = make_env(f"hydra.searchpath=['file://{tmp_path}']", "robot=spider", "obstacles=none", num_envs=2, blind=True)
    assert env.num_actions == 12 and env.robot.num_joints == 12


@pytest.mark.parametrize("name", ["hip #0", "hip: 0", "[hip0]", "0", "on", "a.b c", "- hip"])
def test_any_name_of_a_joint_is_written_so_that_it_is_read(tmp_path, name):
    (tmp_path / "biped.xml").write_text(BIPED.replace('"right_hip"', f'"{name}"'))
    found = guess(tmp_path / "biped.xml", str(tmp_path / "biped.xml"))
    assert name in found.preset["default_joint_pos"]
    assert yaml.safe_load(text_of(found, tmp_path / "biped.xml")) == found.preset


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["robot-new", "none.xml"], "file=none.xml is no file"),
        (["robot-new", "biped.xml", "joints=elbow"], "joints=elbow are no hinges or slides of biped.xml; known: tail"),
        (["robot-new", "ghost.xml"], "no geom collides"),
        (["robot-check", "go2", "robot=anymal"], "robot=anymal: this command sets robot=go2 itself"),
    ],
)
def test_wrong_input_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "biped.xml").write_text(BIPED)
    (tmp_path / "ghost.xml").write_text(BIPED.replace('<geom group="3"/>', '<geom contype="0" conaffinity="0"/>'))
    with pytest.raises(SystemExit, match="2"):
        main(words)
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
