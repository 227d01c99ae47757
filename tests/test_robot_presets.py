"""Every robot preset stands, is mirrored, follows a gait, learns, is randomized, listed, exported and replayed; and how
those are fetched that others publish."""

import hashlib
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from omniperception import build, config
from omniperception.build import build_runner, load_policy
from omniperception.commands import main
from omniperception.commands.robot_check import NO_TASK
from omniperception.config import ConfigError
from omniperception.env.mirror import mirrored_joints
from omniperception.evaluation.trials import baselines
from omniperception.robots import fetch
from omniperception.robots.stand import flat_world, stand
from omniperception.scene.fetched import fetched

sys.path.insert(0, str(Path(__file__).parent))
from own_robots import BIPED_PRESET, skip_if_not_fetched, write_preset

ROBOTS = config.presets("robot")
SMALL = (
    *("num_envs=4", "terrain=flat", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.num_learning_epochs=1"),
    *("ppo.hidden_dims=[16]", "ppo.max_iterations=2"),
)


@pytest.fixture(params=ROBOTS)
def name(request):
    skip_if_not_fetched(request.param)
    return request.param


def robot_of(name):
    return build.assemble(config.compose([*NO_TASK, f"robot={name}", "lidar=none"])).env.robot


def test_the_presets_are_these():
    assert ROBOTS == ("anymal", "g1", "g1_legs", "go1", "go2")


def test_it_stands_on_its_feet(name):
    world = flat_world(robot_of(name))
    found, _ = stand(world)
    feet = {geom for foot in world.robot.feet for geom in foot}
    assert found.steady and all("ground" in pair and feet & set(pair) for pair in found.contacts)
    weight = float(world.model.body_mass[1:].sum()) * 9.81
    assert sum(found.contacts.values()) == pytest.approx(weight, rel=0.05)


def test_the_room_it_takes_holds_it_and_reaches_perception_and_avoidance(name):
    """In the default pose all that can be touched lies within; boxes around geoms by MuJoCo."""
    robot = robot_of(name)
    model = robot.compiled()
    data = mujoco.MjData(model)
    for joint, angle in robot.default_joint_pos.items():
        data.joint(joint).qpos = angle
    data.qpos[:7] = 0, 0, robot.base_height, 1, 0, 0, 0
    mujoco.mj_kinematics(model, data)
    touched = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    turns = data.geom_xmat[touched].reshape(-1, 3, 3)
    boxes = model.geom_aabb[touched].reshape(-1, 2, 3)
    middles = data.geom_xpos[touched] + (turns @ boxes[:, 0, :, None])[..., 0]
    halves = (np.abs(turns) @ boxes[:, 1, :, None])[..., 0]
    low, high = (middles - halves).min(0), (middles + halves).max(0)
    back, front, side = robot.outline
    assert -back < low[0] and high[0] < front and max(-low[1], high[1]) < side and high[2] < robot.height
    given = ["experiment=avoid", f"robot={name}", "init=null"]
    mounted = "+robot.mounts.on_the_base={pos: [0.0, 0.0, 1.0]}"  # perception of this kind refuses a link that turns
    run = build.assemble(config.compose([*given, mounted, "lidar.mount=on_the_base"]))
    geometry = run.perception.sampler().geometry
    assert (geometry.body, geometry.standing, geometry.headroom) == (robot.outline, robot.base_height, robot.height)
    assert run.env.rewards.avoidance.risk.robot_radius == robot.radius and run.env.obstacles.headroom == robot.height
    assert baselines.geometry_of(robot) == geometry


def test_base_height_is_that_of_the_default_pose(name):
    robot = robot_of(name)
    world = flat_world(robot)
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.rest_positions
    data.qpos[:7] = 0, 0, 2.0, 1, 0, 0, 0
    mujoco.mj_kinematics(world.model, data)
    size = world.model.geom_size
    lowest = min(data.geom(geom).xpos[2] - size[world.model.geom(geom).id, 0] for foot in robot.feet for geom in foot)
    assert 2.0 - lowest == pytest.approx(robot.base_height, abs=0.01)


def test_its_gait_is_its_own_mirror_image_half_a_period_later(name):
    """With ppo.symmetry a clock of the opposite sign is the mirror image: each foot's twin is half a period away."""
    robot = robot_of(name)
    index, _ = mirrored_joints(robot)
    assert sorted(index.tolist()) == list(range(robot.num_joints))
    world = flat_world(robot)
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.rest_positions
    mujoco.mj_kinematics(world.model, data)
    places = np.array([np.mean([data.geom(geom).xpos for geom in foot], 0) for foot in robot.feet])
    offsets = np.array(robot.gait.offsets)
    for place, offset in zip(places, offsets, strict=True):
        twin = int(np.linalg.norm(places - place * [1, -1, 1], axis=1).argmin())
        assert (offset - offsets[twin]) % 1.0 == 0.5


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Run directory of two iterations of the gait recipe, by robot."""
    runs = {}

    def of(name: str) -> Path:
        if name not in runs:
            path = tmp_path_factory.mktemp(name)
            run = build.assemble(config.compose(["experiment=gait", f"robot={name}", *SMALL]))
            config.save(run.composed, path)
            runner = build_runner(run, path)
            before = [value.clone() for value in runner.alg.actor.parameters()]
            runner.learn(2)
            assert all(torch.isfinite(value).all() for value in runner.alg.actor.parameters())
            assert any(not torch.equal(a, b) for a, b in zip(before, runner.alg.actor.parameters(), strict=True))
            runs[name] = path
        return runs[name]

    return of


def test_it_learns_the_gait_and_its_export_acts_alike(name, trained):
    pytest.importorskip("onnxruntime", reason="extra deploy")
    pytest.importorskip("onnx", reason="extra export")
    from omniperception.deploy.export import export
    from omniperception.evaluation.trials.exported import ExportedPolicies
    from omnirobot.runtime import ExportedPolicy

    run_dir = trained(name)
    described = export(run_dir, formats=("onnx",))
    robot = robot_of(name)
    assert tuple(described.joints.names) == robot.joints
    clock = next(term for group in described.observations for term in group.terms if term.quantity == "gait_phase")
    assert clock.frequency == robot.gait.frequency
    policy = load_policy(build.assemble(config.load(run_dir, ["num_envs=2"])), run_dir)
    exported = ExportedPolicies(policy.env, ExportedPolicy.load(run_dir / "exported", safety=None))
    with torch.no_grad():
        for _ in range(4):
            expected = policy.policy(policy.env.get_observations())
            got = exported(policy.env.get_observations())
            torch.testing.assert_close(got, expected, atol=1e-5, rtol=0.0)
            policy.env.step(expected)


def test_it_is_randomized_and_sees(name, make_env):
    """With all that a robot is exposed to, its LiDAR where the presets of LiDARs ask for it."""
    blind = ("perception=none", "observations=walk", "rewards=paper")
    env = make_env(f"robot={name}", "randomization=robot", "lidar.num_rays=50", *blind, num_envs=2)
    for _ in range(6):
        observations, reward, _, _ = env.step(torch.zeros(2, env.num_actions))
    assert env.sensing.tick > 0 and torch.isfinite(reward).all()
    assert all(
        torch.isfinite(value.float()).all() for value in observations.values() if isinstance(value, torch.Tensor)
    )


def test_the_plan_lists_it(name, capsys):
    main(["plan", "experiment=walk", f"robot={name}", "num_envs=2"])
    assert capsys.readouterr().out.strip()


@pytest.mark.slow
def test_it_is_replayed(name, trained, tmp_path):
    main(["play", f"run={trained(name)}", "trials=2", "video_s=0.2", "num_envs=2", "terminations.episode_length_s=0.3"])
    assert (trained(name) / "replay.png").is_file()


@pytest.mark.slow
def test_the_ablation_runs_with_it(name, tmp_path):
    given = (
        *(
            "variants=fps_mlp_small",
            "seeds=1",
            "scenarios=corridor",
            "trials=2",
            "num_envs=2",
            "obstacles.curriculum=null",
        ),
        *("ppo.num_steps_per_env=4", "ppo.num_mini_batches=1", "ppo.max_iterations=1", "init=null"),
        *("observations.groups.proprioception.history=1", "terminations.episode_length_s=0.3"),
        *(("perception.base_motion=false",) if name == "g1" else ()),  # its waist turns its LiDAR against the base
    )
    main(["ablate", f"out={tmp_path}", f"robot={name}", *given])
    assert "fps_mlp_small" in (tmp_path / "ablation.md").read_text()


# --- gaits ------------------------------------------------------------------------------------------------------------


def test_a_clock_without_a_gait_is_refused_in_one_line(tmp_path):
    folder = write_preset(tmp_path, preset={key: value for key, value in BIPED_PRESET.items() if key != "gait"})
    with pytest.raises(
        ConfigError, match=r"robot\.gait, or part of it, is missing, .* robot\.gait=\{frequency"
    ) as error:
        build.assemble(config.compose([folder, "robot=biped", "experiment=gait"]))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("robot.gait.offsets=[0.0,0.5]", r"robot\.gait\.offsets=\[0\.0, 0\.5\] must have one for each of the 4 feet"),
        ("robot.gait.offsets=[0.0,0.5,0.5,1.5]", "must be shares of a period"),
        ("robot.gait.duty=1.0", r"duty=1\.0 must be between 0 and 1"),
        ("robot.gait.frequency=0", "frequency=0"),
        ("robot.gait.lift=0", r"robot\.gait\.lift=0 must be positive"),
        ("robot.gait.lin_vel_x=[2,1]", r"robot\.gait\.lin_vel_x=\[2, 1\] must be \[low, high\]"),
    ],
)
def test_a_gait_that_cannot_be_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        build.assemble(config.compose([*NO_TASK, "lidar=none", change]))


# --- downloads --------------------------------------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A wheel with one robot in it, and an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    wheel = tmp_path / "some-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("some/robots/one/xmls/one.xml", "<mujoco/>")
        archive.writestr("some/robots/one/xmls/assets/leg.stl", b"mesh")
        archive.writestr("some/robots/one/secret.py", "1/0")
        archive.writestr("some-1.0.dist-info/licenses/LICENSE", "do as you like")
    sha256 = hashlib.sha256(wheel.read_bytes()).hexdigest()
    found = fetch.Package("some", "1.0", wheel.name, sha256, "some/robots/", {"one": "one"}, "MIT")
    return found, wheel


def test_a_wheel_is_checked_and_its_robots_unpacked_with_the_licence(package):
    found, wheel = package
    folder = fetch.fetch(found, wheel)
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {"one/xmls/one.xml", "one/xmls/assets/leg.stl", "licenses/LICENSE"}
    assert fetched("fetched:some-1.0/one/xmls/one.xml").read_text() == "<mujoco/>"
    assert {path.name for path in folder.parent.iterdir()} == {"some-1.0"}  # nothing else is left


def test_another_wheel_is_refused_and_nothing_written(package):
    found, wheel = package
    with pytest.raises(ConfigError, match=r"has SHA-256 [0-9a-f]{64}; that of some-1.0-py3-none-any.whl is 00"):
        fetch.fetch(replace(found, sha256="00"), wheel)
    with pytest.raises(ConfigError, match="wheel=nowhere.whl is no file"):
        fetch.fetch(found, Path("nowhere.whl"))
    assert not found.folder.exists()


def test_pip_is_asked_for_that_file_alone_and_what_it_says_is_passed_on(package, monkeypatch):
    found, wheel = package
    asked = []

    def pip(command, **_):
        folder = Path(command[command.index("--dest") + 1])
        asked.append((command, Path(command[-1]).read_text()))
        (folder / wheel.name).write_bytes(wheel.read_bytes())
        return fetch.subprocess.CompletedProcess(command, len(asked) - 1, "", "ERROR: no network\n")

    monkeypatch.setattr(fetch.subprocess, "run", pip)
    assert (fetch.fetch(found) / "one" / "xmls" / "one.xml").is_file()
    command, wanted = asked[0]
    assert {"--no-deps", "--require-hashes", "download"} <= set(command) and "install" not in command
    assert wanted == f"some==1.0 --hash=sha256:{found.sha256}\n"
    with pytest.raises(ConfigError, match="pip could not download some==1.0 .*no network.*wheel=some-1.0"):
        fetch.fetch(found)


def test_a_robot_that_was_not_fetched_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(SystemExit, match="2"):
        main(["robot-check", "g1"])
    error = capsys.readouterr().err
    assert "omniperception robot-fetch" in error and error.count("\n") == 1


def test_the_command_leaves_what_is_there(package, monkeypatch, capsys):
    found, wheel = package
    monkeypatch.setattr("omniperception.commands.robot_fetch.MJLAB", found)
    main(["robot-fetch", f"wheel={wheel}"])
    main(["robot-fetch"])
    with pytest.raises(SystemExit, match="2"):
        main(["robot-fetch", f"wheel={wheel}"])
    said, error = capsys.readouterr()
    assert "wheel= would mean nothing: " in error
    assert "written: " in said and "already there: " in said and "robot-check one" in said
