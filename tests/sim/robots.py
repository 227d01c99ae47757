"""Robots that tests of the simulators put into place and move."""

import torch

from omniperception.scene import build_world


def simulator(run, engine, num_envs=4, **options):
    sensors = ("foot_force", "obstacle_contact", "obstacle_force")
    world = build_world(run.env.robot, run.env.terrain, run.env.obstacles, sensors)
    return engine.build(world, num_envs, **options)


def default_joints(sim):
    return torch.tensor(list(sim.world.robot.default_joint_pos.values()), dtype=torch.float64)


def stand(sim):
    """Puts every robot into its default pose, obstacles out of reach."""
    qpos = torch.zeros(sim.num_envs, 19, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = 0.33, 1.0
    qpos[:, 7:] = default_joints(sim)
    sim.mocap_pos[:] = torch.tensor([0.0, 0.0, -100.0])
    sim.mocap_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    sim.reset(torch.arange(sim.num_envs), qpos, torch.zeros(sim.num_envs, 18))


def targets(sim, seed, steps):
    """(steps, num_envs, 12) rad around the default pose."""
    generator = torch.Generator().manual_seed(seed)
    noise = 0.3 * torch.randn(steps, sim.num_envs, 12, generator=generator, dtype=torch.float64)
    return default_joints(sim) + noise
