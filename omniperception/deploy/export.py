"""Exports a run's policy: its network as ONNX and TorchScript, and a description of what goes in and comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from omniperception import build, config
from omniperception.build import RunConfig, build_runner
from omniperception.common.provenance import provenance
from omniperception.config import ConfigError
from omniperception.deploy.description import Description, Group, Joints, Lidar, Perception, Term
from omniperception.deploy.modules import BlindNetwork, exportable, write_onnx, write_torchscript
from omniperception.env.env import MAX_ACTION, OmniEnv
from omniperception.env.mdp import observations
from omniperception.env.mdp.commands import VelocityCommandConfig
from omniperception.learning import latest_checkpoint
from omniperception.learning.checkpoint import load_checkpoint
from omniperception.learning.read_out import MotionReadOut
from omniperception.perception import PdSampler, ProximitySampler, RawSampler, Sampler

FOLDER = "exported"
"""Where in a run directory an exported policy goes."""

FORMATS = {"onnx": "policy.onnx", "torchscript": "policy.pt"}
"""File of each kind of network."""

TOLERANCE = 1e-5
"""Most that an action of an exported network may differ from the actor's."""

STEEP_TOLERANCE = 2e-4
"""The same where the risk of velocities chooses the command: its exponentials and the choice between candidates
multiply the rounding of what perception says (1e-7) some hundred times."""


@dataclass(frozen=True)
class Export:
    """What to export.

    Attributes:
        run_dir: the run.
        out: folder for the files; None: FOLDER in the run directory.
        formats: names from FORMATS.
        trust: packages of one's own whose names the run's configuration may build.
    """

    run_dir: Path
    out: Path | None = None
    formats: Sequence[str] = tuple(FORMATS)
    trust: Sequence[str] = ()

    @property
    def folder(self) -> Path:
        """Where the files go."""
        return self.out if self.out is not None else self.run_dir / FOLDER


def export(request: Export) -> Description:
    """Writes the policy of the newest checkpoint and checks the written networks against the actor."""
    run = build.assemble(config.load(request.run_dir, ["num_envs=1"]), request.trust)
    checkpoint = latest_checkpoint(request.run_dir)
    runner = build_runner(replace(run, env=replace(run.env, initial_obstacle_level=1.0)), None)
    runner.load_policy(checkpoint)
    actor, env = runner.alg.actor.eval(), runner.env
    sizes = {name: env.get_observations()[name].shape[1] for name in run.env.observations.actor}
    network = exportable(actor, sizes)
    described = describe(run, env)
    described = replace(
        described,
        files={name: FORMATS[name] for name in request.formats},
        provenance={
            "run": request.run_dir.resolve().name,
            "checkpoint": checkpoint.name,
            "iteration": load_checkpoint(checkpoint, "cpu")["iteration"],
            **provenance("cpu"),
        },
    )
    _write(request, network, described)
    return described


def describe(run: RunConfig, env: OmniEnv) -> Description:
    """Names, scales and rates of a run's policy; a ConfigError if a robot could not give it what it observes."""
    robot = run.env.robot
    joints = Joints(
        names=robot.joints,
        default_pos=[robot.default_joint_pos[name] for name in robot.joints],
        action_scale=robot.action_scale,
        action_limit=MAX_ACTION,
        kp=robot.kp,
        kd=robot.kv,
        torque_limits=[robot.torque_limits[name] for name in robot.joints],
        lower=env.joint_lower.tolist(),
        upper=env.joint_upper.tolist(),
    )
    return Description(
        control_period_s=env.control_dt,
        joints=joints,
        observations=tuple(_group(name, env) for name in run.env.observations.actor),
        command=_command_ranges(run),
        lidar=_lidar(run) if run.perception is not None else None,
        perception=_perception(run) if run.perception is not None else None,
    )


def _write(request: Export, network: BlindNetwork, described: Description) -> None:
    folder = request.folder
    folder.mkdir(parents=True, exist_ok=True)
    if "torchscript" in request.formats:
        path = folder / FORMATS["torchscript"]
        write_torchscript(network, path)
        _check(network, torch.jit.load(str(path)), path)
    if "onnx" in request.formats:
        path = folder / FORMATS["onnx"]
        write_onnx(network, path)
        session = _onnx_session(path)
        if session is not None:
            _check(network, session, path)
    described.write(folder)


def _check(network: BlindNetwork, written: Callable, path: Path) -> None:
    """A written network gives the actions of the one it was written from, for another batch size, too."""
    inputs = network.examples(23)
    with torch.no_grad():
        error = float((written(*inputs) - network(*inputs)).abs().max())
    steep = isinstance(getattr(network.actor, "read_out", None), MotionReadOut)
    if not error <= (STEEP_TOLERANCE if steep else TOLERANCE):
        raise ConfigError(f"{path} differs from the policy by {error:.1e} in an action: not exportable")


def _onnx_session(path: Path) -> Callable | None:
    """The ONNX network as a function of tensors; None without onnxruntime, which only running it needs."""
    try:
        from onnxruntime import InferenceSession
    except ImportError:
        return None
    session = InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [item.name for item in session.get_inputs()]

    def run(*inputs: torch.Tensor) -> torch.Tensor:
        feed = {name: tensor.numpy() for name, tensor in zip(names, inputs, strict=True)}
        return torch.from_numpy(session.run(None, feed)[0])

    return run


_QUANTITIES = ("joint_pos_offset", "joint_vel", "base_lin_vel", "base_ang_vel", "projected_gravity", "command")
_MEASURABLE = {getattr(observations, name): name for name in (*_QUANTITIES, "previous_action")}
"""Observation terms that a robot can give, by function."""


def _group(name: str, env: OmniEnv) -> Group:
    group = env.config.observations.groups[name]
    terms = []
    for term_name, term in group.terms.items():
        function, options = (term.func, dict(term.keywords)) if isinstance(term, partial) else (term, {})
        if function not in _MEASURABLE or set(options) - {"scale"}:
            raise ConfigError(
                f"observations.groups.{name}.terms.{term_name} cannot be exported: a robot can measure"
                f" {', '.join(_MEASURABLE.values())}"
            )
        size = term(env).shape[1]
        terms.append(Term(_MEASURABLE[function], size, float(options.get("scale", 1.0))))
    return Group(name, group.history, tuple(terms))


def _command_ranges(run: RunConfig) -> dict[str, list[float]]:
    commands = run.env.commands
    if isinstance(commands, VelocityCommandConfig):
        names = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
        return {name: list(getattr(commands, name)) for name in names}
    speed, turn = commands.speed, commands.max_ang_vel_z
    return {"lin_vel_x": [-speed, speed], "lin_vel_y": [-speed, speed], "ang_vel_z": [-turn, turn]}


def _lidar(run: RunConfig) -> Lidar:
    sensor, pattern = run.env.lidar, run.env.lidar.pattern()
    every_kth = sensor.selection == "every_kth"
    return Lidar(
        period_s=sensor.period_s,
        mount_pos=list(sensor.mount_pos),
        mount_quat=list(sensor.quat),
        min_range=sensor.min_range,
        max_range=sensor.max_range,
        num_rays=sensor.num_rays,
        points_per_frame=pattern.points_per_frame(sensor.period_s),
        keep_every=pattern.stride(sensor.period_s, sensor.num_rays) if every_kth else None,
    )


def _perception(run: RunConfig) -> Perception:
    sampler = run.perception.sampler()
    moves = run.perception.base_motion
    return Perception(run.perception.history, sampler.num_points + moves, sampler_figures(sampler), moves)


def sampler_figures(sampler: Sampler) -> dict:
    """Kind and figures of a sampler, as `omniperception.deploy.sampling.make_sampler` takes them."""
    if isinstance(sampler, RawSampler):
        return {"kind": "raw", "num_points": sampler.num_points, "max_range": sampler.max_range}
    if not isinstance(sampler, PdSampler):
        raise ConfigError(f"perception.sampler: a {type(sampler).__name__} cannot be exported")
    halves = {
        "num_proximal": sampler.num_proximal,
        "max_range": sampler.max_range,
        "split": sampler.split if sampler.split != -float("inf") else None,
        "ring": sampler.ring,
    }
    if not isinstance(sampler, ProximitySampler):
        return {"kind": "pd", **halves, "num_distal": sampler.num_distal}
    return {
        "kind": "proximity",
        **halves,
        "num_sectors": sampler.num_sectors,
        "band_edges": [float(f"{edge:.7g}") for edge in sampler.edges.tolist()],
        "decay": sampler.decay,
        "blind": sampler.blind,
        "body": list(sampler.body),
    }
