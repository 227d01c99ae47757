"""What a composed scene consists of and what was left out, each with its reason: read off the objects that exist."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
import yaml
from tensordict import TensorDictBase

from omniperception.config import RunConfig
from omniperception.learning import Runner

if TYPE_CHECKING:
    from omniperception.task.env import OmniEnv

PLAN_FILE = "plan.yaml"
OPTIONAL_PACKAGES = {
    "warp": "casts and samples LiDAR rays",
    "mujoco_warp": "physics on a GPU",
    "matplotlib": "plots",
    "imageio_ffmpeg": "videos",
    "trimesh": "mesh files",
    "mujoco_lidar": "recorded scan tables",
    "viser": "views in a browser",
    "onnx": "export",
    "onnxruntime": "runs exported policies",
}
"""Packages that no run needs altogether, and what for."""

OPTIONAL_FIELDS = {
    "foot_force": "contact sensors of the feet",
    "link_force": "contact sensors of the penalised links",
    "obstacle_contact": "contact sensors of the obstacles",
    "joint_torque": "actuator torques",
    "heights": "heights of the ground around the robot",
    "obstacles": "places and velocities of the obstacles",
    "sectors": "distances to obstacles by sector",
    "rays": "mean distal range",
    "last_action": "the action before the newest",
    "action_before_last": "the action before that",
    "last_joint_vel": "joint velocities one step ago",
}
"""Parts of the task's state that exist only where something reads them."""

_WALKED = ("omniperception.", "mujoco.batch", "rsl_rl.storage")
_LIST_FROM = 0.01
"""Share of the memory from which on a buffer has a line of its own in the text."""


@dataclass(frozen=True)
class Entry:
    """Something that exists or was left out.

    Attributes:
        name: what it is.
        reason: why it is there, or why not.
        detail: how much of it there is; empty for what is not there.
    """

    name: str
    reason: str
    detail: str = ""


@dataclass(frozen=True)
class Section:
    """One kind of things: those that exist and those that were left out."""

    title: str
    has: tuple[Entry, ...]
    left_out: tuple[Entry, ...]


@dataclass(frozen=True)
class Buffer:
    """Memory that a run holds.

    Attributes:
        name: where it hangs in the environment ("env.") or in the rollout ("storage.").
        shape: as allocated.
        num_bytes: altogether.
        per_env: whether it grows with the number of environments.
    """

    name: str
    shape: tuple[int, ...]
    num_bytes: int
    per_env: bool


@dataclass(frozen=True)
class Plan:
    """What a run consists of.

    Attributes:
        sections: everything but memory.
        buffers: memory, the largest first.
        built_envs: environments that were built to find out.
        num_envs: environments of the run.
    """

    sections: tuple[Section, ...]
    buffers: tuple[Buffer, ...]
    built_envs: int
    num_envs: int

    def __getitem__(self, title: str) -> Section:
        return next(section for section in self.sections if section.title == title)

    @property
    def bytes_per_env(self) -> float:
        return sum(b.num_bytes for b in self.buffers if b.per_env) / self.built_envs

    @property
    def shared_bytes(self) -> int:
        return sum(b.num_bytes for b in self.buffers if not b.per_env)

    def summary(self) -> str:
        """One line."""
        left_out = sum(len(section.left_out) for section in self.sections)
        stages, kernels, packages = (len(self[t].has) for t in ("stages of a step", "kernels", "optional packages"))
        kernels = max(kernels - 1, 0)  # without the line of the cache
        return (
            f"plan: {stages} stages a step, {kernels} compiled kernels, {packages} optional packages,"
            f" {self.bytes_per_env / 1e3:.1f} kB an environment and {self.shared_bytes / 1e6:.1f} MB shared;"
            f" {left_out} things left out ({PLAN_FILE} says why)"
        )

    def as_dict(self) -> dict:
        """Plain dicts and lists, as saved."""
        sections = {
            section.title: {
                "has": {e.name: f"{e.detail}; {e.reason}" if e.detail else e.reason for e in section.has},
                "left_out": {e.name: e.reason for e in section.left_out},
            }
            for section in self.sections
        }
        memory = {
            "bytes_per_env": round(self.bytes_per_env),
            "shared_bytes": self.shared_bytes,
            "per_env": {b.name: round(b.num_bytes / self.built_envs) for b in self.buffers if b.per_env},
            "shared": {b.name: b.num_bytes for b in self.buffers if not b.per_env},
        }
        return {"num_envs": self.num_envs, **sections, "memory": memory}

    def text(self) -> str:
        """For a terminal: + what exists, - what was left out."""
        lines = []
        for section in self.sections:
            lines.append(section.title)
            width = max((len(e.name) for e in (*section.has, *section.left_out)), default=0)
            for mark, entries in (("+", section.has), ("-", section.left_out)):
                for e in entries:
                    what = f"{e.detail}  ({e.reason})" if e.detail and e.reason else e.detail or e.reason
                    lines.append(f"  {mark} {e.name:<{width}}  {what}".rstrip())
        return "\n".join((*lines, *self._memory_lines(), self.summary()))

    def _memory_lines(self) -> Iterator[str]:
        yield "memory: bytes per environment"
        total = max(self.bytes_per_env, 1.0)
        listed = [b for b in self.buffers if b.per_env and b.num_bytes / self.built_envs >= _LIST_FROM * total]
        width = max((len(b.name) for b in listed), default=0)
        for b in listed:
            yield f"  + {b.name:<{width}}  {b.num_bytes / self.built_envs:>12,.0f}"
        rest = total - sum(b.num_bytes for b in listed) / self.built_envs
        yield f"    {'smaller ones':<{width}}  {rest:>12,.0f}"
        yield f"    {'altogether':<{width}}  {total:>12,.0f}, {total * self.num_envs / 1e6:,.1f} MB for {self.num_envs}"
        yield f"    {'shared by all':<{width}}  {self.shared_bytes:>12,.0f}"

    def save(self, run_dir: Path) -> None:
        """Writes the plan beside the run's configuration."""
        (run_dir / PLAN_FILE).write_text(yaml.safe_dump(self.as_dict(), sort_keys=False, width=120))


def describe(run: RunConfig, runner: Runner) -> Plan:
    """The plan of a run that has been built.

    Args:
        run: its configuration; tells the reasons and, by `num_envs`, how many environments it is to have.
        runner: what was built of it, of any number of environments; tells what exists.
    """
    env = runner.env
    things = dict(walk({"env": env, "storage": runner.alg.storage}))
    sections = (
        _stages(run, env),
        _kernels(run, env, things),
        _rays(run, env),
        _physics(run, env),
        _fields(run),
        _rewards(run, env),
        _observations(run, env),
        _randomization(run, env),
        _learning(run, runner),
        _packages(run),
    )
    return Plan(sections, _buffers(things, env.num_envs, runner), env.num_envs, run.env.num_envs)


# --- what exists ------------------------------------------------------------------------------------------------------


def walk(roots: Mapping[str, object]) -> Iterator[tuple[str, Any]]:
    """Every array and recorded launch below the roots, by where it hangs; networks are not entered."""
    seen: set[int] = set()
    left = list(reversed(roots.items()))
    while left:
        path, thing = left.pop()
        if id(thing) in seen or isinstance(thing, torch.nn.Module | type):
            continue
        seen.add(id(thing))
        if _is_array(thing) or type(thing).__name__ == "SplitLaunch":
            yield path, thing
        else:
            left += reversed([(f"{path}.{name}", child) for name, child in _children(thing)])


def _is_array(thing: object) -> bool:
    return isinstance(thing, torch.Tensor | np.ndarray) or _is_warp_array(thing)


def _is_warp_array(thing: object) -> bool:
    return "warp" in sys.modules and isinstance(thing, sys.modules["warp"].array)


def _children(thing: object) -> Iterable[tuple[object, object]]:
    if isinstance(thing, TensorDictBase):
        return list(thing.items())
    if isinstance(thing, dict):
        return list(thing.items())
    if isinstance(thing, list | tuple):
        return list(enumerate(thing))
    if type(thing).__name__ == "StructInstance":  # of Warp
        return [(name, getattr(thing, name)) for name in type(thing)._cls.vars]
    if type(thing).__module__.startswith(_WALKED):
        return list(vars(thing).items()) if hasattr(thing, "__dict__") else []
    return []


def _extent(array: Any) -> tuple[int, int]:
    """(address, bytes) of the memory that an array keeps alive."""
    if isinstance(array, torch.Tensor):
        storage = array.untyped_storage()
        return storage.data_ptr(), storage.nbytes()
    if isinstance(array, np.ndarray):
        while isinstance(array.base, np.ndarray):
            array = array.base
        return array.__array_interface__["data"][0], array.nbytes
    return array.ptr or 0, array.capacity


def _buffers(things: Mapping[str, object], num_envs: int, runner: Runner) -> tuple[Buffer, ...]:
    """Arrays by size; one that lies within another's memory is not counted again."""
    arrays = [(name, a, *_extent(a)) for name, a in things.items() if _is_array(a)]
    buffers, spans = [], []
    for name, array, start, size in sorted(arrays, key=lambda item: -item[3]):
        if size == 0 or any(low <= start and start + size <= high for low, high in spans):
            continue
        spans.append((start, start + size))
        shape = tuple(int(n) for n in array.shape)
        buffers.append(Buffer(name, shape, size, num_envs in shape[:2]))
    for name, network in (("actor", runner.alg.actor), ("critic", runner.alg.critic)):
        weights = sum(p.numel() * p.element_size() for p in network.parameters())
        buffers.append(Buffer(f"{name}: weights, gradients and Adam's moments", (), 4 * weights, False))
    return tuple(sorted(buffers, key=lambda b: -b.num_bytes))


# --- sections ---------------------------------------------------------------------------------------------------------


def _section(title: str, *entries: tuple[bool, str, str, str, str]) -> Section:
    """From (exists, name, detail, why it is there, why it is not)."""
    has = tuple(Entry(name, why, detail) for there, name, detail, why, _ in entries if there)
    return Section(title, has, tuple(Entry(name, why_not) for there, name, _, _, why_not in entries if not there))


def _stages(run: RunConfig, env: OmniEnv) -> Section:
    config, sensing = run.env, env.sensing
    sim, lidar = config.sim, _why_no_lidar(run)
    every = f"every {sensing.period_steps} steps" if sensing else ""
    frames = sensing is not None and sensing.frames is not None
    sectors = sensing is not None and sensing.sector_distance is not None
    return _section(
        "stages of a step",
        (
            env.obstacles is not None,
            "obstacles",
            "before each physics step",
            "they are placed and move",
            _no_obstacles(run),
        ),
        (True, "physics", f"{sim.decimation} steps of {1e3 * sim.timestep:g} ms", "", ""),
        (True, "state", "", "", ""),
        (sensing is not None, "rays", every, _readers_of_rays(run), lidar),
        (frames, "sampling", every, "the perception network reads the points", lidar or "no network reads points"),
        (sectors, "sectors", every, _readers(run, "sectors"), lidar or "nothing reads sectors"),
        (env.true_risk is not None, "risk", every, "rewards.avoidance.risk is a law", "rewards.avoidance.risk is null"),
        (env.ground is not None, "terrain", "", "its levels follow how far robots walk", "flat ground has no levels"),
        (True, "rewards", f"{len(config.rewards.terms)} terms, and terminations", "", ""),
        (True, "resets", "", "", ""),
        (True, "observations", f"{len(config.observations.groups)} groups", "", ""),
    )


def _kernels(run: RunConfig, env: OmniEnv, things: Mapping[str, object]) -> Section:
    if env.sensing is None:
        return Section("kernels", (), (Entry("kernels of the LiDAR", _why_no_lidar(run)),))
    names = dict.fromkeys(thing.name for thing in things.values() if type(thing).__name__ == "SplitLaunch")
    entries = [Entry(name, "", _variant(env) if name == "cast_scan" else "") for name in names]
    if env.sensing.sampler is not None:
        entries += [Entry(name, type(env.sensing.sampler).__name__) for name in env.sensing.sampler.kernels]
    if env.true_risk is not None:
        entries.append(Entry("velocity_risks", "rewards.avoidance.risk is a law"))
    return Section("kernels", (*entries, _cache()), ())


def _cache() -> Entry:
    """What this process and Warp's cache on the disk hold of compiled kernels."""
    from omniperception.lidar.kernels.variants import MAX_VARIANTS, kept_variants, num_built

    folder = sys.modules["warp"].config.kernel_cache_dir
    detail = f"{len(kept_variants())} of at most {MAX_VARIANTS} variants kept, {num_built()} built; on disk in {folder}"
    return Entry("cache of variants", "warp.clear_kernel_cache() empties the disk", detail)


def _variant(env: OmniEnv) -> str:
    """What the scan's kernel is compiled for."""
    from omniperception.lidar import ShapeKind

    variant = env.sensing.lidar.variant
    kinds = " ".join(ShapeKind(kind).name.lower() for kind in sorted(variant.kinds))
    options = [name for name in ("packed", "moving", "displaced", "selected", "shots") if getattr(variant, name)]
    parts = {"shapes": kinds, "outputs": " ".join(sorted(variant.outputs)), "noise": " ".join(sorted(variant.noise))}
    parts["options"] = " ".join(options)
    return ", ".join(f"{name}: {value or 'none'}" for name, value in parts.items())


def _rays(run: RunConfig, env: OmniEnv) -> Section:
    if env.sensing is None:
        return Section("ray geometry", (), (Entry("ray scene", _why_no_lidar(run)),))
    scene, lidar = env.sensing.scene, env.sensing.lidar
    kinds = Counter(shape.kind.name.lower() for shape in scene.shapes)
    shapes = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    triangles = sum(len(s.asset.faces) for s in scene.shapes if hasattr(s.asset, "faces"))
    cells = scene.geometry.field_height.size
    return _section(
        "ray geometry",
        (
            True,
            "rays",
            f"{lidar.config.num_rays} a frame, every {lidar.config.period_s:g} s",
            _readers_of_rays(run),
            "",
        ),
        (True, "shapes", f"{len(scene.shapes)}: {shapes}", "", ""),
        (
            scene.num_bodies > 0,
            "moving bodies",
            f"{scene.num_bodies}",
            "their poses are copied each frame",
            "nothing moves",
        ),
        (triangles > 0, "triangles and their trees", f"{triangles}", "meshes", "every shape is exact: no mesh"),
        *((False, geom, "", "", why) for geom, why in env.sensing.hidden.items()),
        (cells > 0, "height field", f"{cells} heights", "the terrain is one", "the ground is a plane"),
    )


def _physics(run: RunConfig, env: OmniEnv) -> Section:
    model, sim = env.world.model, env.sim
    obstacles = len(run.env.obstacles.geom_names())
    sensors = ", ".join(sorted(env.world.sensors))
    return _section(
        "physics",
        (
            True,
            "geoms",
            f"{model.ngeom}: ground, {model.ngeom - 1 - obstacles} of the robot, {obstacles} obstacles",
            "",
            "",
        ),
        (
            True,
            "contact pairs",
            f"{len(contact_pairs(model))}",
            "the robot meets ground and obstacles, nothing else meets",
            "",
        ),
        (True, "degrees of freedom", f"{model.nv}, {model.nu} actuators", "", ""),
        (
            model.nmocap > 0,
            "kinematic bodies",
            f"{model.nmocap}",
            "obstacles or terrain that moves",
            "nothing is moved",
        ),
        (
            model.nsensor > 0,
            "contact sensors",
            f"{model.nsensor}: {sensors}",
            "terms read them",
            "no term reads contacts",
        ),
        *_engine_fields(sim),
    )


def _engine_fields(sim: Any) -> list[tuple[bool, str, str, str, str]]:
    """Fields that the engine copies out after every call, or has once per environment."""
    batch = getattr(sim, "batch", None)
    bound = sorted(getattr(batch, "_bound", ()))
    expanded = sorted(getattr(batch, "_expanded", ()))
    return [
        (
            bool(bound),
            "bound fields",
            ", ".join(bound),
            "copied out after every call",
            "nothing reads more than the state",
        ),
        (bool(expanded), "model fields per environment", ", ".join(expanded), "randomized", "nothing is randomized"),
    ]


def contact_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms that the engine may test for contacts."""
    pairs = []
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            bodies = model.body_weldid[model.geom_bodyid[[a, b]]]
            parents = model.body_weldid[model.body_parentid[bodies]]
            related = (bodies[0] == parents[1] and bodies[0] != 0) or (bodies[1] == parents[0] and bodies[1] != 0)
            types, affinities = model.geom_contype[[a, b]], model.geom_conaffinity[[a, b]]
            meet = (types[0] & affinities[1]) or (types[1] & affinities[0])
            if meet and bodies[0] != bodies[1] and not related:
                pairs.append((a, b))
    return pairs


def _fields(run: RunConfig) -> Section:
    readers = run.env.readers()
    return _section(
        "fields of the state",
        *(
            (name in readers, name, what, _readers(run, name), "nothing reads it")
            for name, what in OPTIONAL_FIELDS.items()
        ),
    )


def _rewards(run: RunConfig, env: OmniEnv) -> Section:
    from omniperception.task.state import fields_read

    kept = run.env.rewards.terms
    entries = []
    for name, term in run.composed["rewards"]["terms"].items():
        if name in kept:
            read = ", ".join(sorted(fields_read(kept[name].func))) or "the state alone"
            entries.append((True, name, f"weight {kept[name].weight:g}", f"reads {read}", ""))
        else:
            entries.append((False, name, "", "", "weight 0" if term else "null"))
    return _section("reward terms", *entries)


def _observations(run: RunConfig, env: OmniEnv) -> Section:
    config, entries = run.env.observations, []
    for name, group in run.composed["observations"]["groups"].items():
        if name not in config.groups:
            entries.append((False, name, "", "", "neither actor nor critic sees it"))
            continue
        who = " and ".join(w for w, groups in (("actor", config.actor), ("critic", config.critic)) if name in groups)
        width, history = env.observations[name].shape[1], config.groups[name].history
        entries.append((True, name, f"{width} values, history {history}", f"{who}", ""))
        for term, given in group["terms"].items():
            if given is None:
                entries.append((False, f"{name}.{term}", "", "", "null"))
    for target in run.env.targets:
        shape = "x".join(str(n) for n in env.observations[target].shape[1:])
        entries.append((True, target, f"{shape} values", "perception is supervised with it", ""))
    frames = "frames" in env.observations
    shape = "x".join(str(n) for n in env.observations["frames"].shape[1:]) if frames else ""
    entries.append(
        (frames, "frames", f"{shape} values", "the perception network reads them", "no network reads points")
    )
    return _section("observations", *entries)


def _randomization(run: RunConfig, env: OmniEnv) -> Section:
    config, entries = run.env.randomization, []
    for item in fields(config):
        value = getattr(config, item.name)
        if item.name == "payload_position":
            continue
        if isinstance(value, tuple):
            entries.append((True, item.name, f"{value[0]:g} to {value[1]:g}", "drawn at every reset", ""))
        elif value:
            entries.append((True, item.name, str(value), "in the scan's kernel", ""))
        else:
            entries.append((False, item.name, "", "", "null" if value is None else "false"))
    return _section("randomization", *entries)


def _learning(run: RunConfig, runner: Runner) -> Section:
    def count(network: torch.nn.Module) -> str:
        return f"{sum(p.numel() for p in network.parameters()):,} parameters"

    entries = [(True, "actor", count(runner.alg.actor), "", ""), (True, "critic", count(runner.alg.critic), "", "")]
    perception = run.perception
    network = getattr(runner.alg.actor, "perception", None)
    there = network is not None
    detail = f"{count(network)} of the actor's, history {network.history}" if there else ""
    entries.append((there, "perception network", detail, "perception is set", "perception=none"))
    for item in fields(perception) if perception else ():
        if item.name.endswith("_weight"):
            weight = getattr(perception, item.name)
            entries.append((weight != 0, f"perception.{item.name}", f"{weight:g}", "supervises the embedding", "0"))
    return _section("learning", *entries)


def _packages(run: RunConfig) -> Section:
    entries = [
        (name in sys.modules, name, what, "imported", f"{what}: not used here")
        for name, what in OPTIONAL_PACKAGES.items()
    ]
    cuda = torch.cuda.is_initialized()
    entries.append((cuda, "CUDA", "initialised", "the run is on a GPU", "the run is on the CPU"))
    return _section("optional packages", *entries)


# --- reasons ----------------------------------------------------------------------------------------------------------


def _readers(run: RunConfig, field: str) -> str:
    return "read by " + ", ".join(run.env.readers().get(field, ("nothing",)))


def _readers_of_rays(run: RunConfig) -> str:
    readers = [name for field in ("sectors", "rays") for name in run.env.readers().get(field, ())]
    readers += ["the perception network"] if run.env.sampler is not None else []
    return "read by " + ", ".join(dict.fromkeys(readers))


def _why_no_lidar(run: RunConfig) -> str:
    if run.env.uses_lidar:
        return ""
    return "lidar=none" if run.env.lidar is None else "nothing reads the LiDAR"


def _no_obstacles(run: RunConfig) -> str:
    return "all obstacles stand where they are" if run.env.obstacles.num_obstacles else "obstacles=none"
