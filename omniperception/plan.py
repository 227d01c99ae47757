"""Parts of a run, read off the objects that exist after a few control steps."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import mujoco
import numpy as np
import torch
import yaml
from tensordict import TensorDictBase

from omniperception.common.files import write_whole
from omniperception.env.env import OmniEnv
from omniperception.env.mixed import MixedEnv, families_of
from omniperception.env.state import EnvState
from omniperception.learning import Runner

if TYPE_CHECKING:
    from omniperception.lidar.launch import SplitLaunch

PLAN_FILE = "plan.yaml"
STEPS = 12
"""Control steps after which every part of a step has run, LiDAR frames included."""
_OPTIONAL = ("warp", "mujoco_warp", "matplotlib", "imageio_ffmpeg", "trimesh", "mujoco_lidar", "onnx", "onnxruntime")
_ENTERED = ("omniperception.", "mujoco.batch", "mujoco_warp.", "rsl_rl.storage")
"""Objects of these modules are looked into, and so are dicts and sequences; networks are not."""


@dataclass(frozen=True)
class Plan:
    """Things that exist, by section and name, with a size or an empty text.

    Attributes:
        num_envs: environments of which this was seen.
        sections: physics, rays, terms, state, stages, kernels, modules.
        buffers: bytes of every array by where it hangs, the largest first.
    """

    num_envs: int
    sections: dict[str, dict[str, str]]
    buffers: dict[str, int]

    def absent(self, fuller: Plan) -> dict[str, list[str]]:
        """By section what `fuller` has and this has not, buffers included."""
        ours: dict[str, Mapping[str, object]] = {**self.sections, "buffers": self.buffers}
        theirs: dict[str, Mapping[str, object]] = {**fuller.sections, "buffers": fuller.buffers}
        return {title: [name for name in names if name not in ours[title]] for title, names in theirs.items()}

    def summary(self) -> str:
        """One line."""
        counts = ", ".join(f"{len(self.sections[title])} {title}" for title in ("terms", "stages", "kernels"))
        return f"plan: {counts}, {sum(self.buffers.values()) / 1e6:.1f} MB for {self.num_envs} environments"

    def save(self, run_dir: Path) -> None:
        """Writes the plan beside the run's configuration."""
        write_whole(run_dir / PLAN_FILE, yaml.safe_dump(asdict(self), sort_keys=False, width=120))

    def text(self, fuller: Plan | None = None, most: int = 12) -> str:
        """For a terminal: + what exists, - what only `fuller` has; at most so many buffers and modules each."""
        absent = {} if fuller is None else self.absent(fuller)
        shown = {**self.sections, "buffers": {name: f"{size:,} bytes" for name, size in self.buffers.items()}}
        lines = []
        for title, names in shown.items():
            lines.append(f"{title}: {len(names)}")
            limit = most if title in ("buffers", "modules") else len(names) + len(absent.get(title, ()))
            lines += [f"  + {name}  {detail}".rstrip() for name, detail in list(names.items())[:limit]]
            lines += [f"  - {name}" for name in absent.get(title, [])[:limit]]
            hidden = [max(n - limit, 0) for n in (len(names), len(absent.get(title, ())))]
            lines += [f"  ... {hidden[0]} more here, {hidden[1]} more absent"] if any(hidden) else []
        return "\n".join((*lines, self.summary()))


class Watch:
    """Notes what is computed in the first control steps of a run, and then describes it."""

    def __init__(self, runner: Runner, then: Callable[[Plan], None]) -> None:
        """
        Args:
            runner: of the run, before its first step.
            then: called with the plan within control step number `STEPS`.
        """
        self._runner, self._then, self._left = runner, then, STEPS
        self._computed, self._stages = set[str](), set[str]()
        self._note_computed()
        runner.env.step_hooks.append(self._look)

    def _note_computed(self) -> None:
        for env in families_of(self._runner.env).values():
            self._computed |= vars(env.state).keys()

    def _look(self) -> None:
        env = self._runner.env
        self._note_computed()
        self._stages |= {stage for own in families_of(env).values() for stage in own.timer.seconds}
        self._left -= 1
        if not self._left:
            env.step_hooks.remove(self._look)
            self._then(describe(self._runner, self._computed, self._stages))


def look(runner: Runner) -> Plan:
    """The plan of a run, for which its environment takes a few steps with random actions and all obstacles."""
    env, found = runner.env, list[Plan]()
    for own in families_of(env).values():
        if own.obstacles is not None:
            own.obstacles.level = 1.0
    Watch(runner, found.append)
    with torch.inference_mode():
        runner.alg.actor(env.get_observations())
        while not found:
            env.step(0.1 * torch.randn(env.num_envs, env.num_actions, device=env.device))
    return found[0]


def describe(runner: Runner, computed: Iterable[str] = (), stages: Iterable[str] = ()) -> Plan:
    """The plan of a run.

    Args:
        runner: of the run.
        computed: names in the environment's state that were computed.
        stages: stages of a step that ran.
    """
    env = runner.env
    things = walk({"env": env, "storage": runner.alg.storage})
    launches = [thing for thing in things.values() if _is_launch(thing)]
    cache = sys.modules.get("omniperception.common.launch")
    launches += [] if cache is None else [launch for launch, _ in cache._launches.values()]
    quantities = {name for name in computed if hasattr(EnvState, name)}
    modules = sorted(name for name in sys.modules if name.startswith("omniperception.") or name in _OPTIONAL)
    sections = {
        "physics": _by_family(env, _physics),
        "rays": _by_family(env, _rays),
        "terms": _by_family(env, _terms),
        "state": dict.fromkeys(sorted(quantities), ""),
        "stages": dict.fromkeys(sorted(stages), ""),
        "kernels": dict.fromkeys(sorted({launch.name for launch in launches}), ""),
        "modules": dict.fromkeys(modules, ""),
    }
    return Plan(env.num_envs, sections, buffers(things))


def contact_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms that the engine may test for contacts."""
    bodies, parents = model.body_weldid[model.geom_bodyid], model.body_weldid[model.body_parentid]

    def may_touch(a: int, b: int) -> bool:
        types, affinities = model.geom_contype[[a, b]], model.geom_conaffinity[[a, b]]
        child = any(bodies[x] != 0 and bodies[x] == parents[bodies[y]] for x, y in ((a, b), (b, a)))
        return bool((types & affinities[::-1]).any()) and bodies[a] != bodies[b] and not child

    explicit = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return [*(pair for pair in combinations(range(model.ngeom), 2) if may_touch(*pair)), *explicit]


def _by_family(env: OmniEnv | MixedEnv, section: Callable[[OmniEnv], dict[str, str]]) -> dict[str, str]:
    """A section of all families, whose names its entries begin with."""
    families = families_of(env).items()
    return {f"{family} {name}".lstrip(): detail for family, own in families for name, detail in section(own).items()}


def _physics(env: OmniEnv) -> dict[str, str]:
    model, world = env.world.model, env.world
    counts = {
        "bodies": model.nbody,
        "geoms": model.ngeom,
        "contact pairs": len(contact_pairs(model)),
        "actuators": model.nu,
        "kinematic bodies": model.nmocap,
        "heights of the ground": model.nhfielddata,
    }
    widths = {kind: world.sensor_slice(kind) for kind in sorted(world.sensors)}
    sensors = {f"contact sensor {kind}": f"{part.stop - part.start} numbers" for kind, part in widths.items()}
    fields = {f"model field {name}": "of each environment" for name in sorted(env.sim.state_dict()["fields"])}
    return {**{name: str(count) for name, count in counts.items() if count}, **sensors, **fields}


def _rays(env: OmniEnv) -> dict[str, str]:
    if env.sensing is None:
        return {}
    scene, lidar = env.sensing.scene, env.sensing.lidar
    kinds = Counter(shape.kind.name.lower() for shape in scene.shapes)
    shapes = {f"shapes {kind}": str(count) for kind, count in sorted(kinds.items())}
    outputs = {f"output {name}": "" for name in lidar.outputs}
    features = {f"kernel feature {name}": "" for name in sorted(lidar.features)}
    frame = f"{lidar.config.num_rays} a frame, every {env.sensing.period_steps} steps"
    return {"rays": frame, "moving bodies": str(scene.num_bodies), **shapes, **outputs, **features}


def _terms(env: OmniEnv) -> dict[str, str]:
    rewards = {f"rewards.{name}": f"weight {term.weight:g}" for name, term in env.config.rewards.terms.items()}
    groups = env.config.observations.groups
    widths = {f"{group}.{name}": width for group in groups for name, width in env.observation_widths(group).items()}
    return {**rewards, **{f"observations.{name}": f"{width} numbers" for name, width in widths.items()}}


# --- objects ----------------------------------------------------------------------------------------------------------


def walk(roots: Mapping[str, object]) -> dict[str, object]:
    """Arrays of torch, NumPy and Warp and recorded launches below the roots, each once, by where they hang."""
    found, seen = {}, set()
    left = list(reversed(list(roots.items())))
    while left:
        path, thing = left.pop()
        if id(thing) in seen or isinstance(thing, torch.nn.Module | type):
            continue
        seen.add(id(thing))
        if _is_launch(thing) or _extent(thing) is not None:
            found[path] = thing
        else:
            left += reversed([(f"{path}.{name}", child) for name, child in _children(thing)])
    return found


def _children(thing: object) -> Iterable[tuple[object, object]]:
    if isinstance(thing, dict | TensorDictBase):
        return list(thing.items())
    if isinstance(thing, list | tuple):
        return list(enumerate(thing))
    kind: Any = type(thing)
    of_warp = any(base.__name__ in ("StructInstance", "Mesh") for base in kind.__mro__)
    if hasattr(thing, "__dict__") and (of_warp or kind.__module__.startswith(_ENTERED)):
        return list(vars(thing).items())
    return []


def buffers(things: Mapping[str, object]) -> dict[str, int]:
    """Bytes of the arrays, the largest first; one that lies within another's memory is not counted again."""
    extents = {name: extent for name, thing in things.items() if (extent := _extent(thing)) is not None}
    sizes: dict[str, int] = {}
    spans: list[tuple[int, int]] = []
    for name, (start, size) in sorted(extents.items(), key=lambda item: -item[1][1]):
        if size and not any(low <= start and start + size <= high for low, high in spans):
            spans.append((start, start + size))
            sizes[name] = size
    return sizes


def _extent(thing: object) -> tuple[int, int] | None:
    """(address, bytes) of the memory that an array keeps alive; None for what is no array."""
    if isinstance(thing, torch.Tensor):
        storage = thing.untyped_storage()
        return storage.data_ptr(), storage.nbytes()
    if isinstance(thing, np.ndarray):
        while isinstance(thing.base, np.ndarray):
            thing = thing.base
        return thing.__array_interface__["data"][0], thing.nbytes
    warp = sys.modules.get("warp")
    if warp is not None and isinstance(thing, warp.array):
        return thing.ptr or 0, thing.capacity
    return None


def _is_launch(thing: object) -> TypeGuard[SplitLaunch]:
    module = sys.modules.get("omniperception.lidar.launch")
    return module is not None and isinstance(thing, module.SplitLaunch)
