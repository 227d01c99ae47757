"""One physics step of a simulator against `mj_step` in float64, from states that a robot really gets into."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from omniperception.scene import World
from omniperception.sim import SimConfig, Simulator
from omniperception.sim.mujoco import apply_options

WARM_UP = 120
"""Physics steps with random joint targets before the states are taken: robots stand, stumble, and lie as they fell."""
CONVERGED = 500
"""Solver iterations of the solution that both are compared with."""


@dataclass(frozen=True)
class StepErrors:
    """Differences after one step, each (num_states,): the largest over the state's coordinates.

    Attributes:
        velocity: between the simulator and `mj_step` with the same settings, m/s or rad/s.
        position: likewise, m or rad (quaternions by component).
        unsolved: between `mj_step` with the same settings and with a converged solver, m/s or rad/s: what the limit of
            solver iterations alone makes, to judge the others by.
        contacts: contacts of each state.
    """

    velocity: np.ndarray
    position: np.ndarray
    unsolved: np.ndarray
    contacts: np.ndarray

    def table(self) -> list[tuple[str, float, float, float]]:
        """(what, median, 99 %, largest) rows."""
        quantiles = (0.5, 0.99, 1.0)
        return [
            ("velocity (m/s, rad/s)", *np.quantile(self.velocity, quantiles).tolist()),
            ("position (m, rad)", *np.quantile(self.position, quantiles).tolist()),
            ("solver's limit of iterations, velocity", *np.quantile(self.unsolved, quantiles).tolist()),
        ]


def step_errors(sim: Simulator, seed: int = 0) -> StepErrors:
    """Steps every environment of `sim`, on flat ground, once from a state of its own, and `mj_step` from the same.

    States come from plain MuJoCo, rounded to float32, so that both start from the same numbers; warm starts are empty.
    """
    model, config = sim.world.model, sim.config
    apply_options(model, config)
    qpos, qvel, targets = _states(model, sim.world, sim.num_envs, np.random.default_rng(seed))
    everyone = torch.arange(sim.num_envs, device=sim.device)
    sim.mocap_pos[:] = torch.tensor([0.0, 0.0, -100.0], dtype=sim.mocap_pos.dtype)
    sim.reset(everyone, *(torch.from_numpy(x).to(sim.device) for x in (qpos, qvel)))
    sim.step(torch.from_numpy(targets).to(sim.device))
    found = [x.cpu().double().numpy() for x in (sim.qpos, sim.qvel)]
    same, contacts = _steps(model, config, qpos, qvel, targets)
    solved, _ = _steps(model, replace(config, iterations=CONVERGED, ls_iterations=CONVERGED), qpos, qvel, targets)
    apply_options(model, config)
    return StepErrors(
        velocity=np.abs(found[1] - same[1]).max(1),
        position=np.abs(found[0] - same[0]).max(1),
        unsolved=np.abs(solved[1] - same[1]).max(1),
        contacts=contacts,
    )


def _states(
    model: mujoco.MjModel, world: World, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(count, nq), (count, nv) and joint targets (count, nu), all exact in float32."""
    robot = world.robot
    default = np.array([robot.default_joint_pos[name] for name in robot.joints])
    data, states = mujoco.MjData(model), []
    for k in range(count):
        mujoco.mj_resetData(model, data)
        roll = rng.uniform(-np.pi, np.pi) if k % 2 else 0.0
        data.qpos[:3], data.qpos[7:] = [0, 0, robot.base_height + 0.05 * abs(roll)], default
        data.qpos[3:7] = [np.cos(roll / 2), np.sin(roll / 2), 0, 0]
        data.mocap_pos[:] = [0, 0, -100]
        for _ in range(WARM_UP + k % 40):
            data.ctrl[:] = default + rng.normal(0.0, 0.03 * (k % 20), model.nu)
            mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy(), default + rng.normal(0.0, 0.3, model.nu)))
    return tuple(np.stack(part).astype(np.float32).astype(np.float64) for part in zip(*states, strict=True))


def _steps(
    model: mujoco.MjModel, config: SimConfig, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    apply_options(model, config)
    data, after, contacts = mujoco.MjData(model), [], []
    for q, v, target in zip(qpos, qvel, targets, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, target
        data.mocap_pos[:] = [0, 0, -100]
        mujoco.mj_step(model, data)
        after.append((data.qpos.copy(), data.qvel.copy()))
        contacts.append(data.ncon)
    return tuple(np.stack(part) for part in zip(*after, strict=True)), np.array(contacts)
