"""Small robots written by hand, as files of others are: unnamed parts, visual geoms, passive joints, odd orders."""

from pathlib import Path

import pytest
import yaml

from omniperception import config
from omniperception.scene.fetched import SCHEME, cache


def skip_if_not_fetched(robot: str) -> None:
    """Skips a test of a preset whose file `robot-fetch` has not brought."""
    skip_if_not_there(config.compose([f"robot={robot}"]).robot.file, f"robot={robot}")


def skip_if_not_there(file: str, what: str) -> None:
    """Skips a test of what needs a robot's file that `robot-fetch` has not brought."""
    if file.startswith(SCHEME) and not (cache() / file.removeprefix(SCHEME)).is_file():
        pytest.skip(f"{what} is downloaded, not shipped: omniperception robot-fetch")


BIPED = """
<mujoco model="biped">
  <compiler angle="radian"/>
  <default>
    <geom group="3"/>
    <default class="look"><geom contype="0" conaffinity="0" group="2" mass="0"/></default>
  </default>
  <worldbody>
    <body name="torso" pos="0 0 0.52">
      <freejoint/>
      <geom class="look" type="box" size="0.3 0.3 0.3"/>
      <geom type="box" size="0.05 0.08 0.08" mass="4"/>
      <body name="tail" pos="-0.05 0 0">
        <joint name="tail" axis="0 1 0" range="-1 1" damping="0.05" frictionloss="0.3" armature="0.002"/>
        <geom type="capsule" fromto="0 0 0 -0.1 0 0" size="0.01" mass="0.1"/>
      </body>
      <body name="right_thigh" pos="0 -0.07 -0.08">
        <joint name="right_hip" axis="0 1 0" range="-1.5 1.5" damping="0.1" frictionloss="0.02" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.8"/>
        <body name="right_shank" pos="0 0 -0.2">
          <joint name="right_knee" axis="0 1 0" range="-0.1 2.2" damping="0.1" frictionloss="0.02" armature="0.01"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.4"/>
          <geom type="box" size="0.06 0.03 0.01" pos="0.02 0 -0.21" mass="0.1"/>
        </body>
      </body>
      <body name="left_thigh" pos="0 0.07 -0.08">
        <joint name="left_hip" axis="0 -1 0" range="-1.5 1.5" damping="0.1" frictionloss="0.02" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.8"/>
        <body name="left_shank" pos="0 0 -0.2">
          <joint name="left_knee" axis="0 1 0" range="-0.1 2.2" damping="0.1" frictionloss="0.02" armature="0.01"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.4"/>
          <geom type="box" size="0.06 0.03 0.01" pos="0.02 0 -0.21" mass="0.1"/>
        </body>
      </body>
      <body name="head" pos="0 0 0.1">
        <joint name="neck" axis="0 0 1" range="-2 2" damping="0.1" armature="0.005"/>
        <geom type="sphere" size="0.05" pos="0 0 0.05" mass="0.5"/>
        <body name="eyes" pos="0.04 0 0.08"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="tail"/></actuator>
  <sensor><jointpos joint="tail"/></sensor>
  <keyframe><key qpos="0 0 0.5 1 0 0 0 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
"""Two legs of two joints whose hips turn in opposite senses, a passive tail, a head that turns, a fixed frame on it; no
geom has a name, and a visual box is larger than the legs are long."""

BIPED_PRESET = {
    "base": "torso",
    "joints": ["left_hip", "left_knee", "neck", "right_hip", "right_knee"],
    "default_joint_pos": {
        "left_hip": 0.2,
        "left_knee": 0.4,
        "neck": 0.0,
        "right_hip": -0.2,
        "right_knee": 0.4,
        "tail": 0.3,
    },
    "base_height": 0.49,
    "kp": {"left_hip": 40.0, "left_knee": 30.0, "neck": 5.0, "right_hip": 40.0, "right_knee": 30.0},
    "kv": {"left_hip": 1.0, "left_knee": 0.8, "neck": 0.2, "right_hip": 1.0, "right_knee": 0.8},
    "torque_limits": {"left_hip": 20.0, "left_knee": 25.0, "neck": 2.0, "right_hip": 20.0, "right_knee": 25.0},
    "action_scale": {"left_hip": 0.5, "left_knee": 0.4, "neck": 0.1, "right_hip": 0.5, "right_knee": 0.4},
    "foot_geoms": ["left_shank_geom_1", "right_shank_geom_1"],
    "penalized_geoms": ["torso_geom_1", "head_geom_0"],
    "footprint": [0.05, 0.07],
    "footing": 0.2,
    "outline": [0.2, 0.2, 0.2],
    "height": 0.8,
    "radius": 0.2,
    "min_base_height": 0.3,
    "mounts": {
        "back": {"pos": [0.0, 0.0, 0.02], "body": "head", "exclude_geoms": ["head_geom_0"]},
        "eyes": {"pos": [0.02, 0.0, 0.0], "rpy": [0.0, 0.3, 0.2], "body": "eyes", "exclude_geoms": ["head_geom_0"]},
    },
}
"""A preset of the biped by hand, with joints in another order than the file's."""

URDF = """
<robot name="hexapod">
  <link name="base_link"/>
  <link name="trunk">
    <inertial><mass value="3"/><inertia ixx="0.03" iyy="0.05" izz="0.06" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/trunk.dae"/></geometry></visual>
    <collision><geometry><box size="0.4 0.2 0.08"/></geometry></collision>
  </link>
  <joint name="base_fixed" type="fixed"><parent link="base_link"/><child link="trunk"/></joint>
  <link name="lidar"/>
  <joint name="lidar_fixed" type="fixed">
    <origin xyz="0.15 0 0.1" rpy="0 0.2 0"/><parent link="trunk"/><child link="lidar"/>
  </joint>
  {legs}
</robot>
"""
LEG = """
  <link name="{leg}_upper">
    <inertial><mass value="0.4"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5707963 0 0" xyz="0 {half} 0"/><geometry><cylinder radius="0.02" length="0.1"/></geometry>
    </collision>
  </link>
  <joint name="{leg}_swing" type="revolute">
    <origin xyz="{x} {y} 0"/><parent link="trunk"/><child link="{leg}_upper"/><axis xyz="0 0 1"/>
    <limit lower="-0.6" upper="0.6" effort="12" velocity="10"/><dynamics damping="0.1" friction="0.05"/>
  </joint>
  <link name="{leg}_lower">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.2"/>
      <inertia ixx="0.0007" iyy="0.0007" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.1"/><geometry><cylinder radius="0.012" length="0.2"/></geometry></collision>
  </link>
  <joint name="{leg}_lift" type="revolute">
    <origin xyz="0 {out} 0"/><parent link="{leg}_upper"/><child link="{leg}_lower"/><axis xyz="1 0 0"/>
    <limit lower="-1.2" upper="1.2" effort="15" velocity="10"/><dynamics damping="0.1"/>
  </joint>
  <link name="{leg}_foot">
    <inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.02"/></geometry></collision>
  </link>
  <joint name="{leg}_foot_fixed" type="fixed">
    <origin xyz="0 0 -0.21"/><parent link="{leg}_lower"/><child link="{leg}_foot"/>
  </joint>
"""
HEXAPOD = URDF.format(
    legs="".join(
        LEG.format(leg=f"{side}{k}", x=0.17 * (1 - k), y=0.1 * s, half=0.05 * s, out=0.1 * s)
        for side, s in (("l", 1), ("r", -1))
        for k in range(3)
    )
)
"""Six legs of two joints on a trunk that is fixed to a root link without mass; 3 + 6 * (0.4 + 0.2 + 0.05) = 6.9 kg."""


def write_preset(folder: Path, text: str = BIPED, preset: dict = BIPED_PRESET, name: str = "biped") -> str:
    """Writes a robot's file and its preset; returns the override that makes presets of the folder known."""
    file = folder / f"{name}{'.urdf' if '<robot' in text else '.xml'}"
    file.write_text(text)
    (folder / "robot").mkdir(exist_ok=True)
    (folder / "robot" / f"{name}.yaml").write_text("# A robot.\n" + yaml.safe_dump({"file": str(file), **preset}))
    return f"hydra.searchpath=['file://{folder}']"
