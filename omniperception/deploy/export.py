"""Exports a run's policy: its network as ONNX and TorchScript, and a description of what goes in and comes out."""

from __future__ import annotations

import copy
import io
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import mujoco
import numpy as np
import torch
from rsl_rl.models import MLPModel
from torch import nn

from omniperception import build
from omniperception.avoidance.velocity import COMMAND, LAST_ASKED
from omniperception.build import RunConfig
from omniperception.common.provenance import provenance
from omniperception.common.vectors import moved_towards
from omniperception.config import ConfigError
from omniperception.deploy.deploy_yaml import FILE as DEPLOY_YAML
from omniperception.deploy.deploy_yaml import deploy_yaml
from omniperception.env.env import MAX_ACTION, OmniEnv
from omniperception.env.mdp import observations
from omniperception.env.mdp.commands import VelocityCommandConfig
from omniperception.env.sensing import SensorConfig, least_bins_of
from omniperception.learning.checkpoint import load_checkpoint
from omniperception.learning.config import PerceptionConfig
from omniperception.learning.estimator import estimates_velocity
from omniperception.learning.models import PerceptionActor
from omniperception.learning.read_out import MotionReadOut
from omniperception.perception import FpsSampler, PdSampler, ProximitySampler, RawSampler, Sampler, StandingSampler
from omniperception.scene import RobotConfig
from omniperception.scene.stepping import stepping_offsets
from omnirobot.common.files import write_whole
from omnirobot.runtime.description import (
    FINGERPRINT,
    Description,
    Group,
    Joints,
    Lidar,
    Perception,
    Stepping,
    Term,
    Turn,
    checksum,
)

FOLDER = "exported"
"""Folder of a run directory for an exported policy."""

FORMATS = {"onnx": "policy.onnx", "torchscript": "policy.pt"}
"""File of each kind of network."""

TOLERANCE = 1e-5
"""Most that an output of an exported network may differ from the actor's, as a share of its largest number, of 1
at least: rounding grows with the numbers, and processors round in different orders."""

STEEP_TOLERANCE = 2e-4
"""The same where the risk of velocities chooses the command: its exponentials and the choice between candidates
multiply the rounding of what perception says (1e-7) some hundred times."""


OPSET = 18
"""ONNX operator set."""


def export(
    run_dir: Path, folder: Path | None = None, formats: Sequence[str] = tuple(FORMATS), trust: Sequence[str] = ()
) -> Description:
    """Write the policy of a run's newest checkpoint and check the written networks against the actor.

    Args:
        run_dir: the run.
        folder: for the files; None: FOLDER in the run directory.
        formats: names from FORMATS.
        trust: packages of one's own whose names the run's configuration may build.

    Raises:
        ConfigError: the policy observes what no robot measures, a written network acts otherwise, or onnx is missing.
        CheckpointError: the run has no checkpoint.
    """
    run = build.load_run(run_dir, ["num_envs=1"], trust)
    trained = build.load_policy(run, run_dir)
    sizes = {name: trained.env.get_observations()[name].shape[1] for name in run.env.observations.actor}
    network = network_of(trained.policy, sizes)
    described = replace(
        describe(run, trained.env),
        files={name: FORMATS[name] for name in formats},
        provenance={
            "run": run_dir.resolve().name,
            "checkpoint": trained.checkpoint.name,
            "weights": checksum(trained.checkpoint),
            "iteration": load_checkpoint(trained.checkpoint, "cpu")["iteration"],
            **provenance("cpu"),
        },
    )
    folder = run_dir / FOLDER if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    for name in FORMATS.keys() - described.files.keys():  # of an earlier export
        (folder / FORMATS[name]).unlink(missing_ok=True)
    for name, file in described.files.items():
        check(network, *_WRITERS[name](network, folder / file))
    if "onnx" in described.files:
        _stamp(folder / described.files["onnx"], described.fingerprint)
    described = replace(described, checksums={name: checksum(folder / file) for name, file in described.files.items()})
    described.write(folder)
    text = deploy_yaml(described)
    if text is None:
        (folder / DEPLOY_YAML).unlink(missing_ok=True)
    else:
        write_whole(folder / DEPLOY_YAML, text)
    return described


def _stamp(path: Path, fingerprint: str) -> None:
    """Write into an ONNX file which description belongs to it."""
    import onnx

    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {FINGERPRINT: fingerprint})
    write_whole(path, model.SerializeToString())


def describe(run: RunConfig, env: OmniEnv) -> Description:
    """Names, scales and rates of a run's policy; a ConfigError if a robot could not give it what it observes."""
    robot = run.env.robot
    joints = Joints(
        names=robot.joints,
        default_pos=list(robot.by_joint("default_joint_pos")),
        action_scale=_of_joints(robot, "action_scale"),
        action_limit=MAX_ACTION,
        kp=_of_joints(robot, "kp"),
        kd=_of_joints(robot, "kv"),
        torque_limits=list(robot.by_joint("torque_limits")),
        lower=_limits(env.state.joint_lower),
        upper=_limits(env.state.joint_upper),
        locked=dict(robot.locked),
    )
    return Description(
        control_period_s=env.control_dt,
        joints=joints,
        observations=tuple(_group(name, env) for name in run.env.observations.actor),
        command=_command_ranges(run),
        command_acceleration=run.env.observations.command_acceleration,
        stepping=_stepping(run),
        lidar=_lidar(run.env.lidar, robot) if run.perception is not None and run.env.lidar is not None else None,
        perception=_perception(run.perception, run.env.lidar) if run.perception is not None else None,
        estimated=_estimated(run),
        max_acceleration=run.max_acceleration,
        turns=run.navigation is not None,
    )


def _of_joints(robot: RobotConfig, name: str) -> float | list[float]:
    """One number where all joints have the same."""
    values = list(robot.by_joint(name))
    return values if len(set(values)) > 1 else values[0]


def _limits(limits: torch.Tensor) -> list[float | None]:
    return [limit if math.isfinite(limit) else None for limit in limits.tolist()]


_QUANTITIES = ("joint_pos_offset", "joint_vel", "base_lin_vel", "base_ang_vel", "projected_gravity", "command")
_MEASURABLE = {getattr(observations, name): name for name in (*_QUANTITIES, "previous_action", "gait_phase")}
"""Observation terms that a robot can give, by function."""


def own_quantity(function: Callable) -> str | None:
    """What a robot measures for an observation term of one's own, by `measured_as`; None for what has no such name."""
    quantity = getattr(function, "quantity", None)
    return None if quantity in _MEASURABLE.values() else quantity


def _group(name: str, env: OmniEnv) -> Group:
    group, widths = env.config.observations.groups[name], env.observation_widths(name)
    terms = []
    for term_name, term in group.terms.items():
        function, options = (term.func, dict(term.keywords)) if isinstance(term, partial) else (term, {})
        quantity, known = own_quantity(function), {"scale", "frequency", "rest_s"} if function in _MEASURABLE else set()
        if (function in _MEASURABLE) == (quantity is not None) or set(options) - known:
            raise ConfigError(
                f"observations.groups.{name}.terms.{term_name} cannot be exported: a robot can measure"
                f" {', '.join(_MEASURABLE.values())}, and terms of your own without parameters that say"
                " @measured_as(<another name>)"
            )
        scale, frequency, rest_s = options.get("scale", 1.0), options.get("frequency"), options.get("rest_s", 0.0)
        terms.append(Term(quantity or _MEASURABLE[function], widths[term_name], scale, frequency, rest_s))
    return Group(name, group.history, tuple(terms))


def _command_ranges(run: RunConfig) -> dict[str, list[float]]:
    commands = run.env.commands
    if isinstance(commands, VelocityCommandConfig):
        names = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
        return {name: list(getattr(commands, name)) for name in names}
    speed, turn = commands.speeds[1], commands.max_ang_vel_z
    return {"lin_vel_x": [-speed, speed], "lin_vel_y": [-speed, speed], "ang_vel_z": [-turn, turn]}


def _stepping(run: RunConfig) -> Stepping | None:
    if run.env.stepping is None or run.env.robot.gait is None:
        return None
    offsets = stepping_offsets(run.env.robot, run.env.stepping.lift).round(6).tolist()
    return Stepping(run.env.robot.gait.frequency, run.env.stepping.rest_s, offsets)


def _estimated(run: RunConfig) -> tuple[str, ...]:
    """What the policy estimates; a ConfigError unless it is what a robot can use: the base's linear velocity."""
    group = run.env.observations.estimated
    if group is None:
        return ()
    if not estimates_velocity(run.env.observations):
        raise ConfigError(f"observations.estimated={group} cannot be exported: it must be true_base_lin_vel alone")
    return ("base_lin_vel",)


def _lidar(sensor: SensorConfig, robot: RobotConfig) -> Lidar:
    pattern = sensor.scan_pattern()
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
        least_bins=least_bins_of(sensor, pattern, robot).tolist(),
        carried_by=() if sensor.mount_body is None else _turns(robot, sensor.mount_body),
    )


def _turns(robot: RobotConfig, carrier: str) -> tuple[Turn, ...]:
    """The joints from the base to the link that carries a sensor; a ConfigError if a passive one turns it."""
    model = robot.compiled()
    links = [model.body(carrier).id]
    while (above := int(model.body_parentid[links[0]])) != model.body(robot.base).id:
        links.insert(0, above)
    found, quat = [], np.array([1.0, 0.0, 0.0, 0.0])
    for link in links:
        mujoco.mju_mulQuat(quat, quat.copy(), model.body_quat[link])
        for joint in range(model.body_jntadr[link], model.body_jntadr[link] + model.body_jntnum[link]):
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                continue
            name = model.joint(joint).name
            if name not in robot.joints:
                raise ConfigError(
                    f"a LiDAR on {carrier} cannot be exported: {name}, between it and {robot.base}, is passive, and its"
                    " angle is not measured; mount it elsewhere (lidar.mount=...), or put the joint into robot.joints"
                )
            rest = float(model.qpos0[model.jnt_qposadr[joint]])
            found.append(Turn(name, quat.tolist(), model.jnt_axis[joint].tolist(), rest))
            quat = np.array([1.0, 0.0, 0.0, 0.0])
    return tuple(found)


def _perception(config: PerceptionConfig, lidar: SensorConfig | None) -> Perception:
    sampler, moves = config.sampler(), config.base_motion
    if lidar is not None and sampler.max_range != lidar.max_range:
        raise ConfigError(
            f"perception.sampler.max_range={sampler.max_range} cannot be exported: on a robot, points beyond it are"
            f" misses, in training those beyond lidar.max_range={lidar.max_range}; train with both the same"
        )
    rows = sampler.num_points + config.num_rows
    return Perception(config.history, rows, sampler_parameters(sampler), moves, config.frame_times)


def sampler_parameters(sampler: Sampler) -> dict:
    """Kind and parameters of a sampler, as `omnirobot.runtime.sampling.make_sampler` takes them."""
    if type(sampler) not in (RawSampler, StandingSampler, PdSampler, FpsSampler, ProximitySampler):
        raise ConfigError(f"perception.sampler: a {type(sampler).__name__} cannot be exported")
    if isinstance(sampler, RawSampler):
        return {"kind": "raw", "num_points": sampler.num_points, "max_range": sampler.max_range}
    if isinstance(sampler, StandingSampler):
        geometry = asdict(sampler.geometry)
        return {"kind": "standing", "max_range": sampler.max_range, **_cells(sampler), "geometry": geometry}
    assert isinstance(sampler, PdSampler)  # and what derives from it
    halves = {
        "num_proximal": sampler.num_proximal,
        "max_range": sampler.max_range,
        "split": sampler.split if sampler.split != -float("inf") else None,
        "ring": sampler.ring,
    }
    if not isinstance(sampler, ProximitySampler):
        return {"kind": "pd", **halves, "num_distal": sampler.num_distal}
    return {"kind": "proximity", **halves, **_cells(sampler), "blind": sampler.blind, "body": list(sampler.body)}


def _cells(sampler: ProximitySampler | StandingSampler) -> dict:
    edges = [float(f"{float(edge):.7g}") for edge in sampler.edges]
    return {"num_sectors": sampler.num_sectors, "band_edges": edges, "decay": sampler.decay}


Outputs = torch.Tensor | tuple[torch.Tensor, ...]
"""Actions, or actions and what `output_names` says besides."""


class BlindNetwork(nn.Module):
    """Flat observations -> actions, and estimates where the actor has an estimator; the observations' normalisation is
    part of it."""

    input_names: Sequence[str] = ("observations",)

    def __init__(self, actor: MLPModel) -> None:
        """Args: actor: copied, on the CPU."""
        super().__init__()
        self.actor = copy.deepcopy(actor).cpu().eval().requires_grad_(False)
        self.output = actor.distribution.as_deterministic_output_module() if actor.distribution else nn.Identity()
        self.observation_size = actor.obs_dim
        self.output_names = ("actions",) if self.actor.estimator is None else ("actions", "estimate")

    def forward(self, observations: torch.Tensor) -> Outputs:
        """(B, observation_size), the actor's groups in order -> (B, num_actions), and estimates (B, K), if any."""
        latent = self.latent(observations)
        return self.outputs(latent, latent)

    def latent(self, observations: torch.Tensor) -> torch.Tensor:
        """(B, D) what the policy's first layer reads of them."""
        latent = self.actor.obs_normalizer(observations)
        estimator = self.actor.estimator
        return latent if estimator is None else torch.cat((latent, estimator(latent)), 1)

    def outputs(self, latent: torch.Tensor, inputs: torch.Tensor, *others: torch.Tensor) -> Outputs:
        """Actions from the first layer's inputs (B, ...), which begin with `latent` (B, D), the estimates in it, and
        others."""
        actions = self.output(self.actor.mlp(inputs))
        estimates = () if self.actor.estimator is None else (latent[:, self.observation_size :],)
        return (actions, *estimates, *others) if estimates or others else actions

    def examples(self, batch: int) -> tuple[torch.Tensor, ...]:
        """Random inputs."""
        return (torch.randn(batch, self.observation_size),)


class PerceptiveNetwork(BlindNetwork):
    """Flat observations and a history of sampled frames -> actions; with a limit of the change of V_cmd + V_avoid the
    one of the step before goes in last, too, and the new one comes out last."""

    input_names: Sequence[str] = ("observations", "frames", "frame_count")

    def __init__(self, actor: PerceptionActor, starts: Mapping[str, int]) -> None:
        """Args: actor: copied, on the CPU; starts: where its groups begin in the observations."""
        super().__init__(actor)
        self.command_start = starts.get(COMMAND, 0)
        self.velocity = [(starts[one.group] + one.column, one.scale) for one in actor.velocity_inputs]
        if actor.max_change is not None:
            self.input_names = (*self.input_names, LAST_ASKED)
            self.output_names = (*self.output_names, "asked")

    def forward(  # type: ignore[override]
        self,
        observations: torch.Tensor,
        frames: torch.Tensor,
        frame_count: torch.Tensor,
        last_asked: torch.Tensor | None = None,
    ) -> Outputs:
        """(B, observation_size), (B, H, P, 3) newest last, (B, 1) int64 newest valid frames, (B, 2) m/s -> as
        `BlindNetwork`, and (B, 2) m/s."""
        features = self.actor.perception(frames, frame_count)[:, 0]
        asked: tuple[torch.Tensor, ...] = ()
        if self.actor.read_out is not None:
            navigates = self.actor.navigation is not None
            start, stop = self.command_start, self.command_start + (3 if navigates else 2)
            command = observations[:, start:stop]
            if navigates:
                velocity = torch.stack([observations[:, at] / scale for at, scale in self.velocity], 1)
                command = self.actor.navigate(features, (frame_count > 0)[:, 0], command, velocity, last_asked)
            else:
                command = command + self.actor.read_out.velocity(features, command) * (frame_count > 0)
                if last_asked is not None:
                    command = moved_towards(last_asked, command, self.actor.max_change)
            asked = () if last_asked is None else (command,)
            observations = torch.cat((observations[:, :start], command, observations[:, stop:]), 1)
        latent = self.latent(observations)
        return self.outputs(latent, torch.cat((latent, features), 1), *asked)

    def examples(self, batch: int) -> tuple[torch.Tensor, ...]:
        """Random inputs, with every number of valid frames in turn."""
        history, points = self.actor.perception.history, self.actor.perception.num_points
        count = torch.arange(batch)[:, None] % (history + 1)
        bearing, nearness = 2 * torch.pi * torch.rand(2, batch, history, points)
        nearness = (-nearness).exp()  # a place in the plane and its proximity, as rows of a grid are
        rows = torch.stack((nearness * bearing.cos(), nearness * bearing.sin(), nearness), -1)
        rows[:, :, -3:] *= 0.1  # motion from frame to frame is small
        width = 2 if self.actor.navigation is None else 3
        asked = () if self.actor.max_change is None else (torch.randn(batch, width),)
        return *super().examples(batch), rows, count, *asked


def network_of(actor: MLPModel, group_sizes: dict[str, int]) -> BlindNetwork:
    """The actor as a network of plain tensors.

    Args:
        actor: of a runner.
        group_sizes: numbers in each of its observation groups, in order.
    """
    if not isinstance(actor, PerceptionActor):
        return BlindNetwork(actor)
    starts = accumulate(group_sizes.values(), initial=0)
    return PerceptiveNetwork(actor, dict(zip(group_sizes, starts, strict=False)))


def write_torchscript(network: BlindNetwork, path: Path) -> tuple[Path, Callable]:
    """Write the network as TorchScript, for any batch size; returns the path and what it runs as."""
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that tracing is deprecated, and that checks of shapes are not traced
        torch.jit.save(torch.jit.trace(network, network.examples(2), check_trace=False), content := io.BytesIO())
    write_whole(path, content.getbuffer())  # torch itself ends the process where the disk is full
    return path, torch.jit.load(str(path))


def write_onnx(network: BlindNetwork, path: Path) -> tuple[Path, Callable | None]:
    """Write the network as ONNX, for any batch size; returns the path and what it runs as, None without onnxruntime.

    torch's TorchScript-based exporter is used: the other one's packages, onnxscript and onnx-ir, are not needed then.
    """
    try:
        import onnx  # noqa: F401  torch's exporter needs it
    except ImportError:
        raise ConfigError(
            "ONNX export needs onnx: pip install 'omniperception[export]', or give formats=torchscript"
        ) from None
    names = list(network.input_names)
    with torch.no_grad(), warnings.catch_warnings(), _plain_scatter():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            network.examples(2),
            content := io.BytesIO(),  # type: ignore[arg-type]  # which it takes without dynamo
            input_names=names,
            output_names=list(network.output_names),
            dynamic_axes={name: {0: "batch"} for name in (*names, *network.output_names)},
            opset_version=OPSET,
            dynamo=False,
        )
    write_whole(path, content.getbuffer())
    try:
        from onnxruntime import InferenceSession
    except ImportError:
        return path, None
    session = InferenceSession(str(path), providers=["CPUExecutionProvider"])

    def run(*inputs: torch.Tensor) -> Outputs:
        feed = {name: tensor.numpy() for name, tensor in zip(names, inputs, strict=True)}
        outputs = tuple(torch.from_numpy(output) for output in session.run(None, feed))
        return outputs if len(outputs) > 1 else outputs[0]

    return path, run


@contextmanager
def _plain_scatter() -> Iterator[None]:
    """Lets `scatter_reduce` become one ScatterElements.

    torch's own rule wraps it in branches for tensors without axes, whose declared shapes are those of the traced batch.
    """
    from torch.onnx import register_custom_op_symbolic, unregister_custom_op_symbolic

    reductions = {"amin": "min", "amax": "max", "sum": "add", "prod": "mul"}

    @torch.onnx.symbolic_helper.parse_args("v", "i", "v", "v", "s", "b")
    def scatter_reduce(g, base, dim, index, source, reduce, include_self):  # type: ignore[no-untyped-def]
        assert include_self and reduce in reductions
        kept = {"axis_i": dim, "reduction_s": reductions[reduce]}
        return g.op("ScatterElements", base, index, source, **kept).setType(base.type())

    register_custom_op_symbolic("aten::scatter_reduce", scatter_reduce, OPSET)
    try:
        yield
    finally:
        unregister_custom_op_symbolic("aten::scatter_reduce", OPSET)


_WRITERS = {"onnx": write_onnx, "torchscript": write_torchscript}


def check(network: BlindNetwork, path: Path, written: Callable | None) -> None:
    """A written network gives the actions of the one it was written from, for other batch sizes, too."""
    if written is None:
        return
    steep = isinstance(getattr(network.actor, "read_out", None), MotionReadOut)
    for batch in (1, 23):
        inputs = network.examples(batch)
        with torch.no_grad():
            sides = [out if isinstance(out, tuple) else (out,) for out in (written(*inputs), network(*inputs))]
        for ours, theirs in zip(*sides, strict=True):
            error = float((ours - theirs).abs().max() / theirs.abs().max().clamp(min=1.0))
            if not error <= (STEEP_TOLERANCE if steep else TOLERANCE):
                raise ConfigError(f"{path} differs from the policy by {error:.1e} of an output: not exportable")
