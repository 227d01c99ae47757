"""Where the physics of a robot holds and where it breaks, and that nothing breaks silently.

    python scripts/stability.py sim.timestep=0.002
    python scripts/stability.py only=standing robot=go1

standing  gains kp 5..2000, kv 0..50 by step 0.5..10 ms, PD in the engine and outside, of a robot on the ground
scenes    corners of the randomization, drops, impacts, overlaps, wild targets, latency

Overrides change the robot and the physics. Writes CSV, JSON, Markdown and a figure (extra `plots`).
docs/lab/stability.md holds what was measured.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.common.random import EnvRandom
from omniperception.env.config import EnvConfig
from omniperception.env.mdp.randomization import RandomizationConfig, Randomizer
from omniperception.scene import build_world
from omniperception.sim import Failure, MujocoSimulator
from omnirobot.common.cli import Command, argument
from omnirobot.common.figures import new_figure

BLIND = ("~experiment", "perception=none", "lidar=none", "rewards=walk", "observations=walk")
PARTS = ("standing", "scenes")
STEPS_MS = (0.5, 1.0, 2.0, 5.0, 10.0)
FRONT = 0.335
"""How far (m) the head reaches before the base's origin."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    only: tuple[str, ...] = argument(PARTS, "parts to run", choices=PARTS)
    out: Path = argument(Path("outputs/stability"), "folder of the results")
    size: int = argument(12, "gains along each axis of a map", least=2)
    num_envs: int = argument(32, "robots of a scene", least=1)
    seconds: float = argument(4.0, "of a scene", positive=True)


# ---- gains -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Map:
    """Grids (kv, kp) for one step and place of the PD law.

    Attributes:
        step_ms, outside: what was simulated; `outside`: PD computed from the state before each step.
        kp, kv: (K,), (V,) gains (N m/rad, N m s/rad).
        speed: (V, K) log10 of the joints' late speed (rad/s, rms).
        failed: (V, K) bool: caught by the simulator.
    """

    step_ms: float
    outside: bool
    kp: np.ndarray
    kv: np.ndarray
    speed: np.ndarray
    failed: np.ndarray


def standing_map(env: EnvConfig, step_ms: float, outside: bool, size: int, seconds: float) -> Map:
    """Robots on the ground, kp from 5 to 2000 N m/rad evenly in its logarithm and kv from 0 to 50 N m s/rad."""
    kp, kv = np.geomspace(5.0, 2000.0, size), np.concatenate([[0.0], np.geomspace(0.1, 50.0, size - 1)])
    kv_of, kp_of = (torch.from_numpy(g.ravel())[:, None] for g in np.meshgrid(kv, kp, indexing="ij"))
    physics = replace(env.sim, timestep=step_ms / 1000.0)
    sim, targets = _standing(replace(env, sim=physics, obstacles=replace(env.obstacles, groups={})), len(kp_of))
    _set_gains(sim, kp_of, kv_of, outside)
    num_steps = round(1000.0 * seconds / step_ms)
    late, count = torch.zeros(len(kp_of), dtype=torch.float64), 0
    for step in range(num_steps):
        torque = kp_of * (targets(0) - sim.qpos[:, 7:]) - kv_of * sim.qvel[:, 6:]
        sim.step(torque if outside else targets(0))
        sim.detect_failures()
        if step >= 0.75 * num_steps:
            late, count = late + sim.qvel[:, 6:].square().mean(1), count + 1
    speed = (late / count).sqrt().log10().nan_to_num(nan=20.0).clamp(-20, 20).numpy().reshape(len(kv), len(kp))
    return Map(step_ms, outside, kp, kv, speed, sim.failed.numpy().reshape(speed.shape))


def map_table(maps: Sequence[Map]) -> Table:
    """One row a map; and every cell, for plots of one's own."""
    rows = [
        {"PD": "outside" if m.outside else "in engine", "step ms": m.step_ms, "gains": m.speed.size}
        | {"unstable": float((m.speed > 0).mean()), "caught": float(m.failed.mean())}
        for m in maps
    ]
    table = Table.of("standing", "gains by step, robots standing", rows)
    table.details["cells"] = [
        {"outside": m.outside, "step ms": m.step_ms, "kp": m.kp[j], "kv": m.kv[i]}
        | {"log10": m.speed[i, j], "caught": bool(m.failed[i, j])}
        for m in maps
        for i, j in np.ndindex(m.speed.shape)
    ]
    return table


def draw_maps(maps: Sequence[Map], path: Path) -> None:
    """One panel for each place of the PD law (rows) and step (columns); crosses: what the simulator caught."""
    figure = new_figure(2.1 * len(STEPS_MS) + 1.0, 4.0)
    axes = figure.subplots(2, len(STEPS_MS), sharex=True, sharey=True)
    for found, axis in zip(maps, axes.flat, strict=True):
        image = axis.imshow(found.speed, origin="lower", aspect="auto", cmap="coolwarm", vmin=-2.0, vmax=2.0)
        caught = np.argwhere(found.failed)
        axis.plot(caught[:, 1], caught[:, 0], "kx", markersize=2)
        every = slice(None, None, max(1, len(found.kp) // 4))
        ticks = np.arange(len(found.kp))[every]
        axis.set_xticks(ticks, [f"{v:.3g}" for v in found.kp[every]])
        axis.set_yticks(ticks, [f"{v:.2g}" for v in found.kv[every]])
        axis.tick_params(labelsize=5)
    for axis, step in zip(axes[0], STEPS_MS, strict=True):
        axis.set_title(f"{step:g} ms", fontsize=8)
    for axis, place in zip(axes[:, 0], ("in engine", "outside"), strict=True):
        axis.set_ylabel(f"PD {place}\nkv (N m s/rad)", fontsize=6)
    for axis in axes[-1]:
        axis.set_xlabel("kp (N m/rad)", fontsize=6)
    figure.colorbar(image, ax=axes, shrink=0.5, label="log10 of late joint speed (rad/s)")
    figure.savefig(path, dpi=80)


# ---- scenes ----------------------------------------------------------------------------------------------------------


@dataclass
class Scene:
    """A robot in trouble.

    Attributes:
        name: of the row.
        sim: the simulations.
        target: joint targets (num_envs, J) of a control step, by its number.
        path: where the obstacles are during each physics step of a control step, by its number; None leaves them.
        delay: control steps by which PD computed outside is late; None: PD in the engine.
    """

    name: str
    sim: MujocoSimulator
    target: Callable[[int], torch.Tensor]
    path: Callable[[int], torch.Tensor] | None = None
    delay: int | None = None


def scenes(env: EnvConfig, num_envs: int, paper: RandomizationConfig) -> Iterator[Scene]:
    """All of them, for the environment's robot and physics settings."""
    yield Scene("standing", *_standing(env, num_envs))
    for name, factor in (("corners of the randomization", 1.0), ("corners of 3 x its ranges", 3.0)):
        sim, target = _standing(env, num_envs)
        corners = replace(widened(paper, factor, sim), joint_offset=None)  # offsets are the task's
        Randomizer(corners, sim, Corners(0, num_envs)).reset(torch.arange(num_envs))
        yield Scene(name, sim, target)
    for name, height in (("drop from 2 m", 2.0), ("5 cm inside the ground", -0.05)):
        sim, target = _standing(env, num_envs)
        sim.qpos[:, 2] += height
        yield Scene(name, sim, target)
    sim, target = _standing(env, num_envs)
    reach = FRONT + env.obstacles.obstacles()[0].group.largest_radius
    sim.mocap_pos[:, 0] = torch.tensor([reach - 0.05, 0.0, 0.3])
    yield Scene("5 cm inside an obstacle", sim, target)
    for speed in (1.5, 3.0, 5.0, 10.0):
        yield _impact(env, num_envs, speed)
    sim, target = _standing(replace(env, terrain=replace(env.terrain, restitution=1.0)), num_envs)
    sim.qpos[:, 2] += 0.5
    yield Scene("restitution 1, drop from 0.5 m", sim, target)
    for friction in (0.05, 0.5, 2.0):
        sim, target = _standing(replace(env, terrain=replace(env.terrain, friction=friction)), num_envs)
        sim.qvel[:, 0] = 1.0
        yield Scene(f"friction {friction:g}, pushed at 1 m/s", sim, target)
    sim, target = _standing(env, num_envs)
    wild = torch.from_numpy(np.random.default_rng(1).choice([-100.0, 100.0], (50, num_envs, 12)))
    yield Scene("joint targets of +-100 rad for 1 s", sim, lambda k: wild[k] if k < 50 else target(k))
    for delay, name in enumerate(("PD outside, once a control step", "PD outside, late by a control period")):
        sim, target = _standing(env, num_envs)
        _set_gains(sim, torch.tensor(env.robot.kp), torch.tensor(env.robot.kv), outside=True)
        yield Scene(name, sim, target, delay=delay)


def play(scene: Scene, seconds: float, gains_of: tuple[float, float]) -> dict[str, object]:
    """Runs a scene; simulations that fail are counted by cause, put back on their feet and go on.

    Energies are kinetic and potential, above that of the standing robot; penetration is the deepest contact.
    """
    sim = scene.sim
    n, decimation = sim.num_envs, sim.config.decimation
    control_steps = round(seconds / sim.config.control_dt)
    stand = sim.qpos.clone()
    stand[:, :3] = torch.tensor([0.0, 0.0, sim.world.robot.base_height])
    gauges = [_Gauge(sim, k) for k in range(min(n, 8))]
    causes = torch.zeros(len(Failure), dtype=torch.int64)
    finite_steps, everyone, felt = 0, torch.arange(n), torch.zeros(n, dtype=torch.bool)
    history = [(sim.qpos.clone(), sim.qvel.clone())] * ((scene.delay or 0) + 1)
    for step in range(control_steps):
        target = scene.target(step)
        if scene.delay is not None:
            history = [*history[1:], (sim.qpos.clone(), sim.qvel.clone())]
            qpos, qvel = history[0]
            target = gains_of[0] * (target - qpos[:, 7:]) - gains_of[1] * qvel[:, 6:]
        sim.step(target, decimation, None if scene.path is None else scene.path(step))
        sim.detect_failures()
        causes += torch.bincount(sim.failure, minlength=len(Failure))
        finite_steps += int((~sim.failed).sum())
        felt |= sim.touched("obstacle_contact")
        failed = everyone[sim.failed]
        if len(failed):
            sim.reset(failed, stand[failed], torch.zeros(len(failed), sim.qvel.shape[1]))
        for gauge in gauges:
            gauge.read()
    named = {cause.name.lower(): int(causes[cause]) for cause in Failure if cause != Failure.NONE and causes[cause]}
    energies = [gauge.energy for gauge in gauges]
    return {
        "scene": scene.name,
        "finite": finite_steps / (n * control_steps),
        "energy J": max(energies) - gauges[0].rest,
        "start J": max(gauge.start for gauge in gauges) - gauges[0].rest,
        "penetration mm": 1e3 * max(gauge.penetration for gauge in gauges),
        "obstacle felt": float(felt.double().mean()),
        "recovered": float(_stands(sim).double().mean()),
        "caught": str(named or "none"),
    }


def widened(config: RandomizationConfig, factor: float, sim: MujocoSimulator) -> RandomizationConfig:
    """Ranges `factor` times as wide about their middle, cut off where nothing physical lies beyond; no LiDAR noise."""
    wide = {"ground_restitution": [0.0, 1.0]}
    for name in (
        *("added_mass", "payload_mass", "com_x", "com_y", "com_z", "ground_friction"),
        *("motor_strength", "joint_offset", "gravity_offset"),
    ):
        low, high = getattr(config, name)
        middle, half = (low + high) / 2, factor * (high - low) / 2
        wide[name] = [middle - half, middle + half]
    for name in ("ground_friction", "motor_strength"):
        wide[name][0] = max(wide[name][0], 0.05)
    base = float(sim.world.model.body_mass[sim.world.base_body])
    lightest = base + wide["added_mass"][0] + wide["payload_mass"][0]
    wide["added_mass"][0] += max(0.0, 0.1 * base - lightest)
    return RandomizationConfig(**wide)


class Corners(EnvRandom):
    """Draws the ends of ranges only."""

    def uniform(self, envs: torch.Tensor, shape: tuple[int, ...] = ()) -> torch.Tensor:
        return super().uniform(envs, shape).round()


class _Gauge:
    """Energy and penetration of one simulation, by the engine's own functions."""

    def __init__(self, sim: MujocoSimulator, index: int) -> None:
        self._sim, self._index = sim, index
        self._model = sim.batch.get_model(index)
        self._model.body_mass[self._model.body_mocapid >= 0] = 0.0  # obstacles are moved; their energy means nothing
        self._data = mujoco.MjData(self._model)
        self.penetration, self.energy = 0.0, -math.inf
        self._data.qpos[:] = sim.qpos[index].numpy()
        self._data.qpos[:3] = 0.0, 0.0, sim.world.robot.base_height
        self.rest = self._energy()
        self.read()
        self.start = self.energy

    def read(self) -> None:
        data = self._data
        data.qpos[:], data.qvel[:] = self._sim.qpos[self._index].numpy(), self._sim.qvel[self._index].numpy()
        if self._sim.mocap_pos.shape[1]:
            data.mocap_pos[:] = self._sim.mocap_pos[self._index].numpy()
        self.energy = max(self.energy, self._energy())
        if data.ncon:
            self.penetration = max(self.penetration, -float(data.contact.dist.min()))

    def _energy(self) -> float:
        mujoco.mj_fwdPosition(self._model, self._data)
        mujoco.mj_fwdVelocity(self._model, self._data)
        mujoco.mj_energyPos(self._model, self._data)
        mujoco.mj_energyVel(self._model, self._data)
        return float(self._data.energy.sum())


def _impact(env: EnvConfig, num_envs: int, speed: float) -> Scene:
    """A cylinder that starts 1 m beside the robot, goes through its place and 2 m on."""
    sim, target = _standing(env, num_envs)
    dt, decimation = sim.config.timestep, sim.config.decimation
    bearing = torch.linspace(0, 2 * torch.pi, num_envs + 1, dtype=torch.float64)[:-1]
    way = torch.stack((bearing.cos(), bearing.sin(), torch.zeros_like(bearing)), -1)
    centre = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)

    def path(step: int) -> torch.Tensor:
        along = speed * dt * (step * decimation + torch.arange(1, decimation + 1, dtype=torch.float64)) - 1.0
        places = sim.mocap_pos[:, None].repeat(1, decimation, 1, 1)
        places[:, :, 0] = way[:, None] * along[:, None].clamp(max=2.0) + centre
        return places

    return Scene(f"struck at {speed:g} m/s", sim, target, path)


def _standing(env: EnvConfig, num_envs: int) -> tuple[MujocoSimulator, Callable[[int], torch.Tensor]]:
    """Robots in the default pose, each joint up to 0.05 rad off, and the targets that keep them there."""
    world = build_world(env.robot, env.terrain, env.obstacles, ("obstacle_contact",))
    sim = MujocoSimulator(world, replace(env.sim, num_threads=1), num_envs)
    joints = torch.tensor([[env.robot.default_joint_pos[name] for name in env.robot.joints]], dtype=torch.float64)
    qpos = torch.zeros(num_envs, 19, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = env.robot.base_height, 1.0
    qpos[:, 7:] = joints + torch.from_numpy(np.random.default_rng(0).uniform(-0.05, 0.05, (num_envs, 12)))
    sim.mocap_pos[:] = torch.tensor([0.0, 0.0, -100.0])
    sim.mocap_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    sim.reset(torch.arange(num_envs), qpos, torch.zeros(num_envs, 18))
    return sim, lambda _: joints.expand(num_envs, -1)


def _set_gains(sim: MujocoSimulator, kp: torch.Tensor, kv: torch.Tensor, outside: bool) -> None:
    """Gains (num_envs, 1) of the position actuators; or motors, whose control is the torque."""
    gain, bias = sim.model_field("actuator_gainprm"), sim.model_field("actuator_biasprm")
    gain[..., 0] = 1.0 if outside else kp
    bias[..., 1] = 0.0 if outside else -kp
    bias[..., 2] = 0.0 if outside else -kv


def _stands(sim: MujocoSimulator) -> torch.Tensor:
    """(num_envs,) bool: upright within 30 degrees, higher than 0.2 m, slower than 0.3 m/s."""
    w, x, y, z = sim.qpos[:, 3:7].unbind(1)
    upright = 1 - 2 * (x * x + y * y) / (w * w + x * x + y * y + z * z)
    return (upright > 0.866) & (sim.qpos[:, 2] > 0.2) & (sim.qvel[:, :3].norm(dim=1) < 0.3)


def measure(given: Arguments, overrides: list[str]) -> Iterator[Table]:
    """A table for each part."""
    env = build.assemble(config.compose([*BLIND, "obstacles=static", *overrides])).env
    paper = build.assemble(config.compose([*BLIND, "randomization=paper"])).env.randomization
    if "scenes" in given.only:
        gains = env.robot.kp, env.robot.kv
        rows = [play(scene, given.seconds, gains) for scene in scenes(env, given.num_envs, paper)]
        yield Table.of("scenes", f"robots in trouble for {given.seconds:g} s", rows)
    if "standing" in given.only:
        maps = [standing_map(env, step, outside, given.size, 1.0) for outside in (False, True) for step in STEPS_MS]
        yield map_table(maps)
        draw_maps(maps, given.out / "standing.png")


def main(given: Arguments, overrides: list[str]) -> None:
    """Measures, prints, writes and draws."""
    folder = given.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(folder):  # which takes the engine's log of diverged simulations, MUJOCO_LOG.TXT
        report(measure(replace(given, out=folder), overrides), about(1), folder)


command = Command(main, Arguments, __doc__, "of the robot and of sim")

if __name__ == "__main__":
    command()
