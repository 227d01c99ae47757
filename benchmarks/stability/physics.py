"""Physics at the extremes: gains against step sizes with the analytic limit, and scenes that shake a robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from omniperception.common.random import EnvRandom
from omniperception.env.config import EnvConfig
from omniperception.env.mdp.randomization import RandomizationConfig, Randomizer
from omniperception.scene import build_world
from omniperception.sim import Failure, MujocoSimulator, SimConfig

INTEGRATORS = ("euler", "implicitfast", "implicit", "rk4")
STEPS_MS = (0.5, 1.0, 2.0, 5.0, 10.0)
FINE = 60
"""Gains along each axis between which the analytic limit is drawn."""
KICK = 1e-3
"""Displacement (rad) from which the joints of a map start: small enough for torque limits not to matter at first."""


@dataclass(frozen=True)
class Map:
    """Grids (kv, kp) for one integrator, step and place of the PD law.

    Attributes:
        integrator, step_ms, outside: what was simulated; `outside`: PD computed from the state before each step.
        kp, kv: (K,), (V,) gains (N m/rad, N m s/rad).
        growth: (V, K) log10 of the energy of the joints at the end over that at the start.
        failed: (V, K) bool: caught by the simulator.
        radius: (V, K) spectral radius of the linearised joints; beyond 1 they are unstable.
        limit: (FINE, FINE) the same between the gains, evenly in their indices; None where nothing is linearised.
    """

    integrator: str
    step_ms: float
    outside: bool
    kp: np.ndarray
    kv: np.ndarray
    growth: np.ndarray
    failed: np.ndarray
    radius: np.ndarray
    limit: np.ndarray | None = None

    @property
    def agreement(self) -> float:
        """Share of the gains, but for those within 1 % of the limit, where theory and simulation say the same."""
        clear = np.abs(self.radius - 1.0) > 0.01
        same = (self.radius > 1.0) == ((self.growth > 0.0) | self.failed)
        return float(same[clear].mean()) if clear.any() else 1.0


def gains(size: int) -> tuple[np.ndarray, np.ndarray]:
    """kp from 5 to 2000 N m/rad, evenly in its logarithm, and kv from 0 to 50 N m s/rad, (size,) each."""
    kv = np.concatenate([[0.0], np.geomspace(0.1, 50.0, size - 1)])
    return np.geomspace(5.0, 2000.0, size), kv


def stability_map(env: EnvConfig, integrator: str, step_ms: float, outside: bool, size: int, num_steps: int) -> Map:
    """Joints kicked a little from their default pose, floating without gravity, under PD with every pair of gains."""
    kp, kv = gains(size)
    grid_kv, grid_kp = (g.ravel() for g in np.meshgrid(kv, kp, indexing="ij"))
    sim = _floating(env, SimConfig(step_ms / 1000.0, integrator=integrator), len(grid_kp))
    kp_of, kv_of = torch.from_numpy(grid_kp)[:, None], torch.from_numpy(grid_kv)[:, None]
    _set_gains(sim, kp_of, kv_of, outside)
    target = _default_joints(sim)
    sim.qpos[:, 7:] += KICK * torch.from_numpy(np.random.default_rng(0).choice([-1.0, 1.0], target.shape[1]))
    inertia = joint_inertia(sim)
    start = _joint_energy(sim, target, kp_of, inertia)
    late = torch.zeros_like(start)
    for step in range(num_steps):
        torque = kp_of * (target - sim.qpos[:, 7:]) - kv_of * sim.qvel[:, 6:]
        sim.step(torque if outside else target)
        sim.detect_failures()
        if step >= 0.9 * num_steps:
            late = torch.maximum(late, _joint_energy(sim, target, kp_of, inertia).nan_to_num(nan=torch.inf))
    growth = torch.log10(late / start).clamp(-20, 20).numpy().reshape(len(kv), len(kp))
    fixed = float(sim.world.model.dof_damping[6:].mean()), step_ms / 1000.0, integrator, outside
    radius = spectral_radius(inertia, kp, kv[:, None], *fixed)
    between = np.linspace(0, size - 1, FINE)
    fine_kp, fine_kv = np.exp(np.interp(between, range(size), np.log(kp))), np.interp(between, range(size), kv)
    limit = spectral_radius(inertia, fine_kp, fine_kv[:, None], *fixed)
    failed = sim.failed.numpy().reshape(growth.shape)
    return Map(integrator, step_ms, outside, kp, kv, growth, failed, radius, limit)


def standing_map(env: EnvConfig, integrator: str, step_ms: float, outside: bool, size: int, seconds: float) -> Map:
    """Robots on the ground under every pair of gains; `growth` is log10 of the joints' late speed (rad/s, rms)."""
    kp, kv = gains(size)
    grid_kv, grid_kp = (g.ravel() for g in np.meshgrid(kv, kp, indexing="ij"))
    physics = replace(env.sim, timestep=step_ms / 1000.0, integrator=integrator)
    sim, targets = _standing(replace(env, sim=physics, obstacles=replace(env.obstacles, groups={})), len(grid_kp))
    kp_of, kv_of = torch.from_numpy(grid_kp)[:, None], torch.from_numpy(grid_kv)[:, None]
    _set_gains(sim, kp_of, kv_of, outside)
    num_steps = round(1000.0 * seconds / step_ms)
    late, count = torch.zeros(len(grid_kp), dtype=torch.float64), 0
    for step in range(num_steps):
        torque = kp_of * (targets(0) - sim.qpos[:, 7:]) - kv_of * sim.qvel[:, 6:]
        sim.step(torque if outside else targets(0))
        sim.detect_failures()
        if step >= 0.75 * num_steps:
            late, count = late + sim.qvel[:, 6:].square().mean(1), count + 1
    growth = (late / count).sqrt().log10().nan_to_num(nan=20.0).clamp(-20, 20).numpy().reshape(len(kv), len(kp))
    failed = sim.failed.numpy().reshape(growth.shape)
    return Map(integrator, step_ms, outside, kp, kv, growth, failed, np.zeros_like(growth))


def joint_inertia(sim: MujocoSimulator) -> np.ndarray:
    """(J, J) inertia (kg m^2) of the joints in the default pose of a robot whose base floats, with armature."""
    model, data = sim.world.model, mujoco.MjData(sim.world.model)
    data.qpos[:] = sim.qpos[0].numpy()
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    for k in range(model.nv):  # M times unit vectors
        unit = np.zeros(model.nv)
        unit[k] = 1.0
        mujoco.mj_mulM(model, data, full[k], unit)
    return np.linalg.inv(np.linalg.inv(full)[6:, 6:])


def spectral_radius(
    inertia: np.ndarray, kp: np.ndarray, kv: np.ndarray, damping: float, step: float, integrator: str, outside: bool
) -> np.ndarray:
    """Largest over the modes m x'' + (kv + d) x' + kp x = 0 of the joints of |eigenvalue| of one step.

    Euler takes the passive damping d implicitly, v+ = ((m - h kv) v - h kp x) / (m + h d), x+ = x + h v+; the implicit
    ones also the actuator's, v+ = (m v - h kp x) / (m + h kv + h d), if the actuator is in the engine; Runge-Kutta's
    step is the polynomial 1 + z + z^2/2 + z^3/6 + z^4/24 of the continuous system, whose torque is held if it comes
    from outside. With d = 0, Euler is stable for kp < (4 m - 2 h kv) / h^2, the implicit ones for
    kp < (4 m + 2 h kv) / h^2.

    Args:
        inertia: (J, J) kg m^2.
        kp, kv: N m/rad and N m s/rad; the result has the shape to which they broadcast.
        damping: d, N m s/rad.
        step: h, s.
        integrator: as in SimConfig.
        outside: whether the torque is computed before the step and held.
    """
    m = np.linalg.eigvalsh(inertia)
    p, v = (x[..., None] for x in np.broadcast_arrays(np.asarray(kp, float), np.asarray(kv, float)))
    rk4 = integrator == "rk4"
    steps = (
        _runge_kutta(m, p, v, damping, step, outside) if rk4 else _euler(m, p, v, damping, step, integrator, outside)
    )
    return np.abs(np.linalg.eigvals(steps)).max((-1, -2))


def _euler(
    m: np.ndarray, kp: np.ndarray, kv: np.ndarray, d: float, h: float, integrator: str, outside: bool
) -> np.ndarray:
    """(..., 2, 2) steps of (x, v) of Euler and of its implicit kin."""
    explicit, implicit = (kv, d) if outside or integrator == "euler" else (0.0, kv + d)
    mass = m + h * implicit
    from_x, from_v = -h * kp / mass, (m - h * explicit) / mass
    return _matrix(1.0 + h * from_x, h * from_v, from_x, from_v)


def _runge_kutta(m: np.ndarray, kp: np.ndarray, kv: np.ndarray, d: float, h: float, outside: bool) -> np.ndarray:
    """(..., 2, 2) steps of (x, v) of the classical Runge-Kutta scheme."""
    spring, rest = _matrix(0.0, 0.0, -kp / m, -kv / m), _matrix(0.0, 1.0, 0.0 * kp, -d / m + 0.0 * kp)
    z = h * (rest if outside else rest + spring)
    powers = [np.linalg.matrix_power(z, k) for k in range(5)]
    step = sum(power / math.factorial(k) for k, power in enumerate(powers))
    if outside:
        step = step + h * sum(power / math.factorial(k + 1) for k, power in enumerate(powers[:4])) @ spring
    return step


def _matrix(*entries: np.ndarray | float) -> np.ndarray:
    """(..., 2, 2) from its entries by rows."""
    return np.stack(np.broadcast_arrays(*entries), -1).reshape(*np.broadcast_shapes(*map(np.shape, entries)), 2, 2)


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


def scenes(env: EnvConfig, num_envs: int, paper: RandomizationConfig) -> list[Scene]:
    """Everything that the issue of stability names, for the environment's robot and physics settings."""
    listed = [Scene("standing", *_standing(env, num_envs))]
    for name, factor in (("corners of the randomization", 1.0), ("corners of 3 x its ranges", 3.0)):
        sim, target = _standing(env, num_envs)
        _randomize(sim, widened(paper, factor, sim))
        listed.append(Scene(name, sim, target))
    for name, height in (("drop from 2 m", 2.0), ("5 cm inside the ground", -0.05)):
        sim, target = _standing(env, num_envs)
        sim.qpos[:, 2] += height
        listed.append(Scene(name, sim, target))
    sim, target = _standing(env, num_envs)
    reach = FRONT + env.obstacles.obstacles()[0].group.largest_radius
    sim.mocap_pos[:, 0] = torch.tensor([reach - 0.05, 0.0, 0.3])
    listed.append(Scene("5 cm inside an obstacle", sim, target))
    listed += [_impact(env, num_envs, speed) for speed in (1.5, 3.0, 5.0, 10.0)]
    sim, target = _standing(replace(env, terrain=replace(env.terrain, restitution=1.0)), num_envs)
    sim.qpos[:, 2] += 0.5
    listed.append(Scene("restitution 1, drop from 0.5 m", sim, target))
    for friction in (0.05, 0.5, 2.0):
        sim, target = _standing(replace(env, terrain=replace(env.terrain, friction=friction)), num_envs)
        sim.qvel[:, 0] = 1.0
        listed.append(Scene(f"friction {friction:g}, pushed at 1 m/s", sim, target))
    sim, target = _standing(env, num_envs)
    signs = np.random.default_rng(1).choice([-100.0, 100.0], (50, num_envs, 12))
    listed.append(
        Scene("joint targets of +-100 rad for 1 s", sim, lambda k: torch.from_numpy(signs[k]) if k < 50 else target(k))
    )
    for delay in (0, 1):
        sim, target = _standing(env, num_envs)
        kp, kv = torch.tensor(env.robot.kp), torch.tensor(env.robot.kv)
        _set_gains(sim, kp.expand(num_envs, 1), kv.expand(num_envs, 1), outside=True)
        name = "PD outside, late by a control period" if delay else "PD outside, once a control step"
        listed.append(Scene(name, sim, target, delay=delay))
    return listed


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
    recovered = _stands(sim)
    named = {cause.name.lower(): int(causes[cause]) for cause in Failure if cause != Failure.NONE and causes[cause]}
    energies = [gauge.energy for gauge in gauges]
    return {
        "scene": scene.name,
        "finite": finite_steps / (n * control_steps),
        "energy J": max(energies) - gauges[0].rest,
        "start J": max(gauge.start for gauge in gauges) - gauges[0].rest,
        "penetration mm": 1e3 * max(gauge.penetration for gauge in gauges),
        "obstacle felt": float(felt.double().mean()),
        "recovered": float(recovered.double().mean()),
        "caught": str(named or "none"),
    }


def widened(config: RandomizationConfig, factor: float, sim: MujocoSimulator) -> RandomizationConfig:
    """Ranges `factor` times as wide about their middle, cut off where nothing physical lies beyond; no LiDAR noise."""
    ranges = {}
    for name in ("added_mass", "payload_mass", "com_x", "com_y", "com_z", "ground_friction", "ground_restitution"):
        ranges[name] = getattr(config, name)
    for name in ("motor_strength", "joint_offset", "gravity_offset"):
        ranges[name] = getattr(config, name)
    wide = {}
    for name, (low, high) in ranges.items():
        middle, half = (low + high) / 2, factor * (high - low) / 2
        wide[name] = [middle - half, middle + half]
    wide["ground_restitution"] = [0.0, 1.0]
    for name in ("ground_friction", "motor_strength"):
        wide[name][0] = max(wide[name][0], 0.05)
    base = float(sim.world.model.body_mass[sim.world.base_body])
    lightest = base + wide["added_mass"][0] + wide["payload_mass"][0]
    if lightest < 0.1 * base:
        wide["added_mass"][0] += 0.1 * base - lightest
    return RandomizationConfig(**wide)


class Corners(EnvRandom):
    """Draws the ends of ranges only."""

    def uniform(self, envs: torch.Tensor, shape: tuple[int, ...] = ()) -> torch.Tensor:
        return super().uniform(envs, shape).round()


FRONT = 0.335
"""How far (m) the head reaches before the base's origin."""


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
    joints = _default_joints(sim)
    qpos = torch.zeros(num_envs, 19, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = env.robot.base_height, 1.0
    qpos[:, 7:] = joints + torch.from_numpy(np.random.default_rng(0).uniform(-0.05, 0.05, (num_envs, 12)))
    sim.mocap_pos[:] = torch.tensor([0.0, 0.0, -100.0])
    sim.mocap_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    sim.reset(torch.arange(num_envs), qpos, torch.zeros(num_envs, 18))
    return sim, lambda _: joints.expand(num_envs, -1)


def _floating(env: EnvConfig, config: SimConfig, num_envs: int) -> MujocoSimulator:
    world = build_world(env.robot, env.terrain, replace(env.obstacles, groups={}))
    world.model.opt.gravity[:] = 0.0
    sim = MujocoSimulator(world, replace(config, num_threads=1), num_envs)
    qpos = torch.zeros(num_envs, 19, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3], qpos[:, 7:] = 10.0, 1.0, _default_joints(sim)
    sim.reset(torch.arange(num_envs), qpos, torch.zeros(num_envs, 18))
    return sim


def _set_gains(sim: MujocoSimulator, kp: torch.Tensor, kv: torch.Tensor, outside: bool) -> None:
    """Gains (num_envs, 1) of the position actuators; or motors, whose control is the torque."""
    gain, bias = sim.model_field("actuator_gainprm"), sim.model_field("actuator_biasprm")
    gain[..., 0] = 1.0 if outside else kp
    bias[..., 1] = 0.0 if outside else -kp
    bias[..., 2] = 0.0 if outside else -kv


def _randomize(sim: MujocoSimulator, config: RandomizationConfig) -> None:
    """Every simulation at a corner of its own; joint offsets, which are the task's, stay out."""
    Randomizer(replace(config, joint_offset=None), sim, Corners(0, sim.num_envs)).reset(torch.arange(sim.num_envs))


def _default_joints(sim: MujocoSimulator) -> torch.Tensor:
    robot = sim.world.robot
    return torch.tensor([[robot.default_joint_pos[name] for name in robot.joints]], dtype=torch.float64)


def _joint_energy(sim: MujocoSimulator, target: torch.Tensor, kp: torch.Tensor, inertia: np.ndarray) -> torch.Tensor:
    """(num_envs,) J: kinetic energy of the joints with a floating base, and that of the springs."""
    speed, offset = sim.qvel[:, 6:], sim.qpos[:, 7:] - target
    return ((speed @ torch.from_numpy(inertia)) * speed).sum(1) / 2 + kp[:, 0] * offset.square().sum(1) / 2


def _stands(sim: MujocoSimulator) -> torch.Tensor:
    """(num_envs,) bool: upright within 30 degrees, higher than 0.2 m, slower than 0.3 m/s."""
    w, x, y, z = sim.qpos[:, 3:7].unbind(1)
    upright = 1 - 2 * (x * x + y * y) / (w * w + x * x + y * y + z * z)
    return (upright > 0.866) & (sim.qpos[:, 2] > 0.2) & (sim.qvel[:, :3].norm(dim=1) < 0.3)
