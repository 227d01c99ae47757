"""What it would cost to have what a scene does not need: each thing forced in, against the scene as it is."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial

import torch

from benchmarks.resident import resident_bytes
from omniperception import build, config
from omniperception.build import RunConfig, build_runner
from omniperception.env.env import EnvConfig, OmniEnv
from omniperception.env.mdp import rewards
from omniperception.env.mdp.terms import RewardTerm
from omniperception.plan import OPTIONAL_FIELDS, OPTIONAL_PACKAGES, describe

SCENES = {
    "walk": ("experiment=walk",),
    "quickstart": ("experiment=quickstart", "obstacles.curriculum=null"),
    "camera": ("experiment=quickstart", "obstacles.curriculum=null", "lidar=depth_camera", "randomization=none"),
    "everything": (
        "experiment=avoid",
        "obstacles.curriculum=null",
        "terrain=mixed",
        "observations=paper",
        "randomization=paper",
    ),
}
"""Walking blind on flat ground; the quickstart; it with a camera that sees few links; everything on."""

NO_EFFECT = 1e-30
"""Weight of a reward term that is computed and changes nothing."""

Force = Callable[[EnvConfig], "EnvConfig"]


@dataclass(frozen=True)
class ForcedConfig(EnvConfig):
    """A task in which `forced` fields are made although nothing reads them.

    Attributes:
        forced: names out of `omniperception.plan.OPTIONAL_FIELDS`.
    """

    forced: tuple[str, ...] = ()

    def readers(self) -> dict[str, tuple[str, ...]]:
        return {**dict.fromkeys(self.forced, ("forced in",)), **super().readers()}


def _unchanged(config: EnvConfig) -> EnvConfig:
    return config


def _with_fields(config: EnvConfig, *names: str) -> EnvConfig:
    given = {item.name: getattr(config, item.name) for item in fields(EnvConfig)}
    return ForcedConfig(**given, forced=(*getattr(config, "forced", ()), *names))


def _with_lidar(config: EnvConfig) -> EnvConfig:
    if config.lidar is not None:
        return config
    return _with_fields(replace(config, lidar=_default("lidar")), "sectors", "rays")


def _with_state(config: EnvConfig) -> EnvConfig:
    blind = {"sectors", "rays"} if config.lidar is None else set()
    return _with_fields(config, *sorted(OPTIONAL_FIELDS.keys() - blind))


def _with_terms(config: EnvConfig) -> EnvConfig:
    more = {
        "foot_stumble": partial(rewards.foot_stumble, ratio=5.0, unit=1.0),
        "link_collision": partial(rewards.link_collision, unit=1.0),
        "joint_velocities": rewards.joint_velocity_squared,
        "action_accelerations": rewards.action_acceleration_squared,
        "alive": rewards.alive,
        "closing_speed": partial(rewards.closing_speed, horizon=1.5, margin=0.6),
    }
    terms = {name: RewardTerm(NO_EFFECT, func) for name, func in more.items()}
    return replace(config, rewards=replace(config.rewards, terms={**terms, **config.rewards.terms}))


def _with_randomization(config: EnvConfig) -> EnvConfig:
    friction = config.terrain.friction
    fixed = dict.fromkeys(("added_mass", "payload_mass", "com_x", "com_y", "com_z", "joint_offset"), (0.0, 0.0))
    fixed |= {"gravity_offset": (0.0, 0.0), "motor_strength": (1.0, 1.0), "latency_s": (0.0, 0.0)}
    fixed |= {"ground_friction": (friction, friction), "ground_restitution": (0.0, 0.0)}
    given = {name: value for name, value in fixed.items() if getattr(config.randomization, name) is None}
    return replace(config, randomization=replace(config.randomization, **given))


def _with_noise(config: EnvConfig) -> EnvConfig:
    from omniperception.lidar import AngularJitter, DistanceNoise, Dropout, GaussianNoise, MaskNoise, MixedPixels

    nothing = {
        "lidar_mask": MaskNoise(0.0),
        "lidar_distance": DistanceNoise(0.0),
        "lidar_gaussian": GaussianNoise(0.0),
        "lidar_jitter": AngularJitter(0.0),
        "lidar_dropout": Dropout(0.0),
        "lidar_mixed": MixedPixels(min_gap=1e8, max_gap=1e9),
    }
    given = {name: model for name, model in nothing.items() if getattr(config.randomization, name) is None}
    return replace(config, randomization=replace(config.randomization, **given))


def _default(group: str) -> object:
    return getattr(build.assemble(config.compose([])).env, group)


@contextmanager
def _replaced(owner: object, name: str, value: object) -> Iterator[None]:
    kept = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, kept)


@contextmanager
def _all_outputs() -> Iterator[None]:
    from omniperception.env import sensing
    from omniperception.lidar import OUTPUTS

    with _replaced(sensing, "_outputs_read", lambda *_: OUTPUTS):
        yield


@contextmanager
def _all_kinds() -> Iterator[None]:
    from omniperception.lidar import RayScene, ShapeKind

    with _replaced(RayScene, "kinds", property(lambda _: frozenset(int(kind) for kind in ShapeKind))):
        yield


@contextmanager
def _all_links() -> Iterator[None]:
    from omniperception.env import sensing

    kept = sensing.hidden_geoms

    def excluded_only(world: object, exclude: Sequence[str], view: object) -> dict[str, str]:
        found = kept(world, exclude, view)
        return {name: why for name, why in found.items() if name in exclude}

    with _replaced(sensing, "hidden_geoms", excluded_only):
        yield


@dataclass(frozen=True)
class Item:
    """Something that can be forced in.

    Attributes:
        name: what.
        change: the same task with it.
        during: what the environment is built under.
        scenes: where it would otherwise be left out.
    """

    name: str
    change: Force = _unchanged
    during: Callable[[], object] = ExitStack
    scenes: tuple[str, ...] = tuple(SCENES)


SEEING = ("quickstart", "camera", "everything")
ITEMS = (
    Item("a LiDAR that nobody reads", _with_lidar, scenes=("walk",)),
    Item("all fields of the state, read or not", _with_state),
    Item("reward terms of weight 0, computed", _with_terms),
    Item("all physical randomization, of size 0", _with_randomization, scenes=("walk", "quickstart", "camera")),
    Item("all LiDAR outputs", during=_all_outputs, scenes=SEEING),
    Item("kernels for all kinds of shapes", during=_all_kinds, scenes=SEEING),
    Item("all noise models, of size 0", _with_noise, scenes=SEEING),
    Item("links that no ray reaches", during=_all_links, scenes=("camera",)),
)


@dataclass(frozen=True)
class Gain:
    """What forcing something in cost.

    Attributes:
        scene, item: where and what.
        step_us: CPU time (us) of an environment's control step in the scene as it is.
        step_ratio: CPU time with the item, by without: median of pairs, lowest, highest.
        bytes_per_env: memory per environment without and with it, rollout included.
    """

    scene: str
    item: str
    step_us: float
    step_ratio: tuple[float, float, float]
    bytes_per_env: tuple[float, float]


def measure(scene: str, num_envs: int, repeats: int, blocks: int = 2) -> list[Gain]:
    """Each item of a scene against the scene as it is, in turn in one process on one thread.

    Args:
        scene: one of SCENES.
        num_envs: environments.
        repeats: pairs of timings.
        blocks: LiDAR frames per timing.
    """
    run = _run_of(scene, num_envs)
    plain = OmniEnv(run.env)
    plain_bytes = _bytes_per_env(run, run.env, ExitStack)
    steps = blocks * (plain.sensing.period_steps if plain.sensing is not None else 5)
    gains = []
    for item in items_of(scene):
        changed = item.change(run.env)
        with item.during():
            forced = OmniEnv(changed)
        pairs = _pairs(plain, forced, repeats, steps)
        ratios = sorted(b / a for a, b in pairs)
        step_us = 1e6 * statistics.median(a for a, _ in pairs) / (steps * num_envs)
        spread = statistics.median(ratios), ratios[0], ratios[-1]
        gains.append(Gain(scene, item.name, step_us, spread, (plain_bytes, _bytes_per_env(run, changed, item.during))))
    return gains


def items_of(scene: str) -> tuple[Item, ...]:
    """The items that a scene leaves out, and all of them together."""
    items = tuple(item for item in ITEMS if scene in item.scenes)
    return (*items, Item("everything above", partial(_changed_by, items), partial(_under, items), (scene,)))


def _changed_by(items: Sequence[Item], config: EnvConfig) -> EnvConfig:
    for item in items:
        config = item.change(config)
    return config


@contextmanager
def _under(items: Sequence[Item]) -> Iterator[None]:
    with ExitStack() as stack:
        for item in items:
            stack.enter_context(item.during())
        yield


def _run_of(scene: str, num_envs: int) -> RunConfig:
    if scene not in SCENES:
        raise config.ConfigError(f"scene={scene} is unknown; known: {', '.join(SCENES)}")
    small = (f"num_envs={num_envs}", "sim.num_threads=1")
    run = build.assemble(config.compose([*SCENES[scene], *small]))
    return replace(run, env=replace(run.env, log_interval=10**9, initial_obstacle_level=1.0))


def _pairs(plain: OmniEnv, forced: OmniEnv, repeats: int, steps: int) -> list[tuple[float, float]]:
    """CPU seconds of both for the same actions, in turn, after a round that does not count."""
    generator, pairs = torch.Generator().manual_seed(0), []
    for _ in range(repeats + 1):
        actions = 0.3 * torch.randn(steps, plain.num_envs, plain.num_actions, generator=generator)
        pairs.append((_seconds(plain, actions), _seconds(forced, actions)))
    return pairs[1:]


def _seconds(env: OmniEnv, actions: torch.Tensor) -> float:
    start = time.process_time()
    with torch.inference_mode():
        for action in actions:
            env.step(action)
    return time.process_time() - start


def _bytes_per_env(run: RunConfig, env: EnvConfig, during: Callable[[], object]) -> float:
    built = replace(run, env=replace(env, num_envs=13))
    with during():
        return describe(built, build_runner(built, None)).bytes_per_env


@dataclass(frozen=True)
class StartUp:
    """A fresh process until its environment and networks stand.

    Attributes:
        scene: which.
        forced: whether everything that the scene leaves out is there, optional packages too.
        cpu_s: CPU seconds.
        memory_mb: largest resident memory, MB.
        modules: Python modules imported.
    """

    scene: str
    forced: bool
    cpu_s: float
    memory_mb: float
    modules: int


def start_up(scene: str, num_envs: int, repeats: int) -> list[StartUp]:
    """Start-up as it is and with everything forced in: medians over fresh processes, in turn."""
    found: dict[bool, list[dict]] = {False: [], True: []}
    for _ in range(repeats):
        for forced, runs in found.items():
            call = f"from {__name__} import start; start({scene!r}, {num_envs}, {forced})"
            done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, env=os.environ)
            if done.returncode:
                raise RuntimeError(f"start-up of {scene} failed: {done.stderr.strip().splitlines()[-1]}")
            runs.append(json.loads(done.stdout.splitlines()[-1]))

    def median(runs: list[dict], key: str) -> float:
        return statistics.median(run[key] for run in runs)

    keys = ("cpu_s", "memory_mb", "modules")
    return [StartUp(scene, forced, *(median(runs, key) for key in keys)) for forced, runs in found.items()]


def start(scene: str, num_envs: int, forced: bool) -> None:
    """Builds a scene in this process and prints what it took, as JSON."""
    run, during = _run_of(scene, num_envs), ExitStack
    if forced:
        everything = items_of(scene)[-1]
        run, during = replace(run, env=everything.change(run.env)), everything.during
        for package in OPTIONAL_PACKAGES:
            _import_if_installed(package)
    with during():
        build_runner(run, None)
    taken = {"cpu_s": time.process_time(), "memory_mb": resident_bytes(peak=True) / 2**20, "modules": len(sys.modules)}
    print(json.dumps(taken))


def _import_if_installed(name: str) -> None:
    try:
        __import__(name)
    except ImportError:
        return


START_HEADER = ("| scene | start-up, CPU time | resident memory | modules |", "|---|---|---|---|")


def step_header(num_envs: int) -> tuple[str, str]:
    """Head of the Markdown table of gains."""
    columns = ("forced in", "step, CPU time", "pairs", "bytes per environment")
    return f"| scene, {num_envs} environments | {' | '.join(columns)} |", "|---|---|---|---|---|"


def step_row(gain: Gain) -> str:
    """A line of that table."""
    (median, low, high), (before, after) = gain.step_ratio, gain.bytes_per_env
    return (
        f"| {gain.scene} ({gain.step_us:.1f} us) | {gain.item} | x {median:.2f} | {low:.2f} to {high:.2f} |"
        f" {before:,.0f} -> {after:,.0f} |"
    )


def start_row(plain: StartUp, forced: StartUp) -> str:
    """A line of the table of start-ups."""
    return (
        f"| {plain.scene} | {plain.cpu_s:.1f} s, forced {forced.cpu_s:.1f} s | {plain.memory_mb:.0f} MB, forced"
        f" {forced.memory_mb:.0f} MB | {plain.modules:.0f}, forced {forced.modules:.0f} |"
    )
