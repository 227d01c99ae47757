"""What a composed scene consists of and what was left out, each with its reason: read off the objects that exist."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import torch
import yaml

from omniperception.build import RunConfig
from omniperception.env.config import HEIGHT_TARGET
from omniperception.env.env import OmniEnv
from omniperception.env.state import AVOIDANCE, CLOUD, DISTAL_RANGE, requirements
from omniperception.inventory import Buffer, buffers_of, is_launch, walk
from omniperception.learning import Runner
from omniperception.learning.read_out import MotionReadOut

if TYPE_CHECKING:
    pass

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

_LISTED_FROM = 0.01
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


class Section:
    """Things of one kind: those that exist and those that were left out."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.has: list[Entry] = []
        self.left_out: list[Entry] = []

    def add(self, name: str, detail: str = "", why: str = "") -> None:
        self.has.append(Entry(name, why, detail))

    def leave_out(self, name: str, why: str) -> None:
        self.left_out.append(Entry(name, why))

    def either(self, there: bool, name: str, detail: str, why: str, why_not: str) -> None:
        """Adds something where it is there, and the reason why not where it is not."""
        if there:
            self.add(name, detail, why)
        else:
            self.leave_out(name, why_not)


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
        counts = {title: len(self[title].has) for title in ("stages of a step", "kernels", "optional packages")}
        left_out = sum(len(section.left_out) for section in self.sections)
        return (
            f"plan: {', '.join(f'{count} {title}' for title, count in counts.items())},"
            f" {self.bytes_per_env / 1e3:.1f} kB an environment and {self.shared_bytes / 1e6:.1f} MB shared;"
            f" {left_out} things left out, {PLAN_FILE} says why"
        )

    def as_dict(self) -> dict:
        """Plain dicts and lists, as saved."""
        sections = {
            section.title: {
                "has": {e.name: "; ".join(filter(None, (e.detail, e.reason))) for e in section.has},
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

    def save(self, run_dir: Path) -> None:
        """Writes the plan beside the run's configuration."""
        (run_dir / PLAN_FILE).write_text(yaml.safe_dump(self.as_dict(), sort_keys=False, width=120))

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
        shares = {b.name: b.num_bytes / self.built_envs for b in self.buffers if b.per_env}
        listed = {name: share for name, share in shares.items() if share >= _LISTED_FROM * total}
        width = max(map(len, listed), default=0)
        for name, share in listed.items():
            yield f"  + {name:<{width}}  {share:>12,.0f}"
        yield f"    {'smaller ones':<{width}}  {total - sum(listed.values()):>12,.0f}"
        yield f"    {'altogether':<{width}}  {total:>12,.0f}, {total * self.num_envs / 1e6:,.1f} MB for {self.num_envs}"
        yield f"    {'shared by all':<{width}}  {self.shared_bytes:>12,.0f}"


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
        _kernels(run, runner, things),
        _rays(run, env),
        _physics(run, env),
        _rewards(run),
        _observations(run, env),
        _randomization(run),
        _learning(run, runner),
        _packages(),
    )
    buffers = [*buffers_of(things, env.num_envs), *_networks(runner)]
    return Plan(sections, tuple(sorted(buffers, key=lambda b: -b.num_bytes)), env.num_envs, run.env.num_envs)


def _networks(runner: Runner) -> Iterator[Buffer]:
    for name, network in (("actor", runner.alg.actor), ("critic", runner.alg.critic)):
        weights = sum(p.numel() * p.element_size() for p in network.parameters())
        yield Buffer(f"{name}: weights, gradients, Adam's moments", (), 4 * weights, False)


# --- sections ---------------------------------------------------------------------------------------------------------


def _stages(run: RunConfig, env: OmniEnv) -> Section:
    section, sensing, sim = Section("stages of a step"), env.sensing, run.env.sim
    blind = _why_blind(run)
    obstacles = "all obstacles stand where they are" if run.env.obstacles.num_obstacles else "obstacles=none"
    section.either(env.obstacles is not None, "obstacles", "", "they move before each physics step", obstacles)
    section.add("physics", f"{sim.decimation} steps of {1e3 * sim.timestep:g} ms")
    section.add("state")
    every = f"every {sensing.period_steps} steps" if sensing else ""
    section.either(sensing is not None, "rays", every, _readers_of_rays(run), blind)
    sampled = _sensing(env, "frames") is not None
    measured = env.avoidance is not None and env.avoidance.sector_distance is not None
    section.either(sampled, "sampling", every, "the network reads points", blind or "no network reads points")
    section.either(measured, "sectors", every, _readers(run, AVOIDANCE), blind or "nothing reads sectors")
    avoided = env.avoidance is not None
    section.either(avoided, "avoidance", every, _readers(run, AVOIDANCE), blind or "nothing reads V_avoid")
    late = run.env.targets and HEIGHT_TARGET in run.env.targets and not env.heights_each_step
    section.either(bool(late), "heights", every, "supervision", "no network is supervised with them alone")
    section.either(env.ground is not None, "terrain", "", "levels follow how far robots walk", "flat ground")
    section.add("rewards", f"{len(run.env.rewards.terms)} terms, and terminations")
    section.add("resets")
    section.add("observations", f"{len(run.env.observations.groups)} groups")
    return section


def _kernels(run: RunConfig, runner: Runner, things: dict[str, object]) -> Section:
    section, env = Section("kernels"), runner.env
    sensing = env.sensing
    for name in dict.fromkeys(thing.name for thing in things.values() if is_launch(thing)):
        section.add(name, " ".join(sorted(sensing.lidar.features)) if name == "cast_scan" else "")
    for name in _sensing(env, "sampler").kernels if _sensing(env, "frames") is not None else ():
        section.add(name, "", type(sensing.sampler).__name__)
    for name, why in dict((*_kernels_of_policy(runner), *_kernels_beside(run, env))).items():
        section.add(name, "", why)
    if sensing is None:
        section.leave_out("those of the LiDAR", _why_blind(run))
    return section


def _kernels_beside(run: RunConfig, env: OmniEnv) -> Iterator[tuple[str, str]]:
    """Kernels that are launched on tensors which come with each call, and why."""
    avoidance = env.avoidance
    if avoidance is not None and avoidance.true_sectors is not None:
        yield "nearest_by_sector", "rewards.avoidance.risk is set"
    if avoidance is not None and avoidance.risk is not None:
        yield "worst_sectors", "rewards.avoidance.risk is set"
    if env.ground is not None:
        yield "heights_at", "robots and obstacles start on the ground"
        yield "base_heights", "height above ground that is not flat"
    if env.ground is not None and (env.heights_each_step or HEIGHT_TARGET in run.env.targets):
        yield "heights_around", "the heights are read"
    if env.ground is not None and env.obstacles is not None:
        yield "lift", "obstacles move over ground that is not flat"


def _kernels_of_policy(runner: Runner) -> Iterator[tuple[str, str]]:
    """Kernels inside the actor."""
    actor = runner.alg.actor
    rings = getattr(getattr(actor, "perception", None), "rings", None)
    if rings is not None:
        yield "write_rings", "perception.network.rings"
    if isinstance(getattr(actor, "read_out", None), MotionReadOut):
        yield "worst_sectors", "perception.motion_weight: risks follow from what is perceived"


def _rays(run: RunConfig, env: OmniEnv) -> Section:
    section = Section("ray geometry")
    if env.sensing is None:
        section.leave_out("ray scene", _why_blind(run))
        return section
    scene, lidar = env.sensing.scene, env.sensing.lidar.config
    kinds = Counter(shape.kind.name.lower() for shape in scene.shapes)
    triangles = sum(len(shape.asset.faces) for shape in scene.shapes if hasattr(shape.asset, "faces"))
    heights = scene.geometry.field_height.size
    section.add("rays", f"{lidar.num_rays} a frame, every {lidar.period_s:g} s", _readers_of_rays(run))
    parts, limit = len(env.sensing.slices_of(run.env.num_envs)), f"lidar.cloud_mb={env.sensing.config.cloud_mb:g}"
    never = f"{limit}: the clouds of all environments never exist at once; scripts/memory.py counts on that"
    section.either(parts > 1, "parts of a frame", f"{parts}", never, f"{limit} is enough, or whole clouds are read")
    section.add("shapes", f"{len(scene.shapes)}: " + ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())))
    moving = f"{scene.num_bodies}"
    section.either(scene.num_bodies > 0, "moving bodies", moving, "poses copied each frame", "nothing moves")
    section.either(triangles > 0, "trees of triangles", f"{triangles} triangles", "meshes", "every shape is exact")
    section.either(heights > 0, "height field", f"{heights} heights", "tiled terrain", "the ground is a plane")
    return section


def _physics(run: RunConfig, env: OmniEnv) -> Section:
    section, model = Section("physics"), env.world.model
    obstacles = len(run.env.obstacles.geom_names())
    section.add("geoms", f"{model.ngeom}: ground, {model.ngeom - 1 - obstacles} of the robot, {obstacles} obstacles")
    section.add("contact pairs", f"{len(contact_pairs(model))}", "the robot with ground and obstacles, no others")
    section.add("degrees of freedom", f"{model.nv}, {model.nu} actuators")
    section.either(model.nmocap > 0, "kinematic bodies", f"{model.nmocap}", "they are moved", "nothing is moved")
    kinds = f"{model.nsensor}: {', '.join(sorted(env.world.sensors))}"
    section.either(model.nsensor > 0, "contact sensors", kinds, "terms read them", "no term reads contacts")
    batch = getattr(env.sim, "batch", None)  # of the native engine
    bound, expanded = (sorted(getattr(batch, name, ())) for name in ("_bound", "_expanded"))
    section.either(bool(bound), "bound fields", ", ".join(bound), "copied out after calls", "the state is enough")
    own = "model fields per environment"
    section.either(bool(expanded), own, ", ".join(expanded), "randomized", "no parameter of physics is randomized")
    return section


def contact_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms that the engine may test for contacts."""
    pairs = []
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            bodies = model.body_weldid[model.geom_bodyid[[a, b]]]
            parents = model.body_weldid[model.body_parentid[bodies]]
            related = any(bodies[k] == parents[1 - k] and bodies[k] != 0 for k in (0, 1))
            types, affinities = model.geom_contype[[a, b]], model.geom_conaffinity[[a, b]]
            meet = (types[0] & affinities[1]) or (types[1] & affinities[0])
            if meet and bodies[0] != bodies[1] and not related:
                pairs.append((a, b))
    return pairs


def _rewards(run: RunConfig) -> Section:
    section, kept = Section("reward terms"), run.env.rewards.terms
    given = run.composed["rewards"]["terms"]
    for name in dict.fromkeys((*given, *kept)):
        if name in kept:
            needed = ", ".join(sorted(requirements(kept[name].func)))
            section.add(name, f"weight {kept[name].weight:g}", needed and f"requires {needed}")
        else:
            section.leave_out(name, "null" if given[name] is None else "weight 0")
    return section


def _observations(run: RunConfig, env: OmniEnv) -> Section:
    section, config = Section("observations"), run.env.observations
    for name, group in run.composed["observations"]["groups"].items():
        if name not in config.groups:
            section.leave_out(name, "neither actor nor critic sees it")
            continue
        sees = [who for who in ("actor", "critic") if name in getattr(config, who)]
        values = f"{env.observations[name].shape[1]} values, history {config.groups[name].history}"
        section.add(name, values, " and ".join(sees))
        for term in (term for term, given in group["terms"].items() if given is None):
            section.leave_out(f"{name}.{term}", "null")
    for name in (*run.env.targets, "frames"):
        there = name in env.observations.keys()  # noqa: SIM118  (a TensorDict is no dict)
        shape = "x".join(str(n) for n in env.observations[name].shape[1:]) if there else ""
        why = "the network reads points" if name == "frames" else "perception is supervised with it"
        section.either(there, name, f"{shape} values", why, "no network reads points")
    return section


def _randomization(run: RunConfig) -> Section:
    section, config = Section("randomization"), run.env.randomization
    for name in (item.name for item in fields(config) if item.name != "payload_position"):
        value = getattr(config, name)
        if isinstance(value, tuple):
            section.add(name, f"{value[0]:g} to {value[1]:g}", "drawn at every reset")
        elif value:
            section.add(name, "" if value is True else str(value), "in the scan's kernel")
        else:
            section.leave_out(name, "null" if value is None else "false")
    return section


def _learning(run: RunConfig, runner: Runner) -> Section:
    section, network = Section("learning"), getattr(runner.alg.actor, "perception", None)

    def count(module: torch.nn.Module) -> str:
        return f"{sum(p.numel() for p in module.parameters()):,} parameters"

    section.add("actor", count(runner.alg.actor))
    section.add("critic", count(runner.alg.critic))
    detail = f"{count(network)} of the actor's, history {network.history}" if network is not None else ""
    section.either(network is not None, "perception network", detail, "", "perception=none")
    weights = [item.name for item in fields(run.perception) if item.name.endswith("_weight")] if run.perception else []
    for name in weights:
        weight = getattr(run.perception, name)
        section.either(weight != 0, f"perception.{name}", f"{weight:g}", "supervises the embedding", "weight 0")
    return section


def _packages() -> Section:
    section = Section("optional packages")
    for name, what in OPTIONAL_PACKAGES.items():
        section.either(name in sys.modules, name, what, "imported", f"{what}: not imported")
    section.either(torch.cuda.is_initialized(), "CUDA", "", "initialised", "the run is on the CPU")
    return section


# --- reasons ----------------------------------------------------------------------------------------------------------


def _sensing(env: OmniEnv, name: str) -> object | None:
    """An attribute of the LiDAR's part of an environment; None without one."""
    return getattr(env.sensing, name, None)


def _readers(run: RunConfig, *names: str) -> str:
    """The terms that require one of the names, and the network."""
    rewards = {f"rewards.{name}": term.func for name, term in run.env.rewards.terms.items()}
    groups = run.env.observations.groups.items()
    seen = {f"observations.{group}.{name}": term for group, its in groups for name, term in its.terms.items()}
    readers = [name for name, term in (rewards | seen).items() if requirements(term) & set(names)]
    readers += [f"supervision.{target}" for target in run.env.targets if target != HEIGHT_TARGET]
    return "read by " + (", ".join(readers) or "nothing")


def _readers_of_rays(run: RunConfig) -> str:
    network = ", the perception network" if run.env.sampler is not None else ""
    return _readers(run, AVOIDANCE, DISTAL_RANGE, CLOUD) + network


def _why_blind(run: RunConfig) -> str:
    if run.env.uses_lidar:
        return ""
    return "lidar=none" if run.env.lidar is None else "nothing reads the LiDAR"
