"""Simulates a Go2 with a Mid-360 on the robot's own wire, in real time.

    robot-sim run=pretrained/avoider scenario=moving condition=robot
    robot-sim run=pretrained/avoider scenario=corridor steer_to=9000    # and in another terminal:
    robot policy=exported points=packets host=127.0.0.1 steer=udp:9000

MuJoCo steps of 2 ms; rt/lowstate at 500 Hz; LiDAR packets of 96 points, cast every 10 ms while the robot moves. The
robot lies on the ground until it is told to stand up; the world stands still until it does. With steer_to the
simulation plays the operator: it asks to stand and to walk, and sends the world's command.

The physics of a condition are there, and the LiDAR's noise; what it adds to readings (latency, errors) is not: the
wire has its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import OmegaConf

from omniperception import build, config
from omniperception.deploy.simulated import CONTROL_STEPS, STEP_S, SimulatedConfig, run
from omniperception.env.env import OmniEnv
from omnirobot.common.cli import Command, argument, refuse_overrides, trust

WIRE = {
    "sim": "mujoco",
    "sim.timestep": STEP_S,
    "sim.decimation": CONTROL_STEPS,
    "sim.num_threads": 1,
    "num_envs": 1,
}
"""What the wire's timing needs, of one robot."""


@dataclass(frozen=True, kw_only=True)
class Arguments(SimulatedConfig):
    """The command's arguments."""

    run: str = argument("latest", "run directory, for the robot, its LiDAR and the world")
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Simulates, and prints what became of the robot."""
    for name in ("point_to", "steer_to"):
        port = getattr(arguments, name)
        if port is not None and not 0 < port < 65536:
            raise config.ConfigError(f"{name}={port} must be a port, 1 to 65535")
    env = world(config.find_run(arguments.run), overrides, arguments.trust)
    print(run(env, arguments))


def world(run_dir: Path, overrides: list[str], trust: Sequence[str] = ()) -> OmniEnv:
    """The robot of a run in its world, with all obstacles, as a policy is evaluated.

    Raises:
        ConfigError: an override is unknown, or changes WIRE.
    """
    refuse_overrides(overrides, WIRE)
    own = dict(WIRE)
    if OmegaConf.select(config.read(run_dir), "sim.type") == own["sim"]:  # with settings of the run's
        del own["sim"]
    run = build.load_run(run_dir, [*overrides, *(f"{key}={value}" for key, value in own.items())], trust)
    build.check_split(run, "trial on the wire", run_dir)
    return OmniEnv(replace(run.env, skip_curricula=True, trials=True))


command = Command(main, Arguments, __doc__, overrides="of the run's configuration")
