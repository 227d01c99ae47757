"""Evaluation of runs in worlds, beside baselines: which trials, in which processes, and what becomes of the results."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
import yaml
from omegaconf import OmegaConf, open_dict

from omnilidar.launch import default_num_threads
from omniperception import build, config
from omniperception.build import RunConfig, TrainedPolicy, load_policy
from omniperception.common.provenance import CHANGES, ROOT, provenance
from omniperception.config import ConfigError
from omniperception.deploy.export import FOLDER as EXPORTED
from omniperception.env.config import EnvConfig
from omniperception.evaluation.report.gaits import walking_table
from omniperception.evaluation.report.plots import draw_worlds
from omniperception.evaluation.report.records import FOLDER, Record, merge, read, write
from omniperception.evaluation.report.tables import progress_line, table
from omniperception.evaluation.trials.baselines import baseline, commanded_ranges, prepared
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.exported import ExportedPolicies
from omniperception.evaluation.trials.policies import BASELINES, DRIVEN, POLICIES, Settings
from omniperception.evaluation.trials.tracks import Tracks
from omniperception.learning import CheckpointError, latest_checkpoint
from omnirobot.common.errors import check_known, naming, one_line
from omnirobot.common.figures import check_figures
from omnirobot.runtime import ExportedPolicy
from omnirobot.runtime.description import FILE as DESCRIPTION
from omnirobot.runtime.description import checksum

LOG = Path("docs") / "lab" / "evaluations.jsonl"
"""Where evaluations on the test split are noted, below a checkout."""
_SCENE = (*config.FIXED_BY_SCENARIO, *config.FIXED_BY_CONDITION)
"""Groups of a configuration that say where a policy is tried, not what it is."""
_TEST_SEEDS = 2**31, 2**42
"""First of the seeds on the test split, and how many there are: far from what anybody types."""


@dataclass(frozen=True)
class World:
    """Where a policy is tried.

    Attributes:
        name: preset of `scenario`.
        terrain: preset of `terrain`; None: the scenario's own.
    """

    name: str
    terrain: str | None = None


@dataclass(frozen=True)
class Evaluation(Settings):
    """An evaluation.

    Attributes:
        runs: run directories; several are the same training with other seeds.
        worlds: where.
        policies: names from POLICIES.
        walker: run directory of a policy that follows velocity commands, for the policies that drive a gait; or None.
        overrides: changes to the configuration, on top of the scenario's.
    """

    runs: Sequence[Path]
    worlds: Sequence[World]
    policies: Sequence[str] = ("run",)
    walker: Path | None = None
    overrides: Sequence[str] = ()

    def __post_init__(self) -> None:
        folders = config.search_path(self.overrides, config.read(self.runs[0]))
        named = {
            "scenario": [world.name for world in self.worlds],
            "terrain": [world.terrain for world in self.worlds if world.terrain is not None],
            "condition": [self.condition] if self.condition is not None else [],
        }
        for group, names in named.items():
            check_known(group, names, config.presets(group, folders))
        for override in config.parse(self.overrides):
            given, name = override.input_line, override.key_or_group
            if name in ("scenario", "num_envs", "condition", "obstacles.split"):
                raise ConfigError(f"{given} is not an override here; it is an argument of its own")
            if self.split == "test" and name == "seed":
                raise ConfigError(f"{given}: the seed of split=test follows from the weights; use split=dev")

    def tasks(self) -> list[Task]:
        """What has to be measured, in the order of the table."""
        return [
            Task(self, run_dir, policy, world)
            for world in self.worlds
            for policy in self.policies
            for run_dir in self.runs
        ]


def suite_worlds(name: str, folders: Sequence[Path] = ()) -> list[World]:
    """The worlds of a suite, a file of conf/suite with the terrains of each scenario."""
    path = config.listed(config.SUITES, name, folders)
    try:
        worlds = yaml.safe_load(path.read_text())["worlds"]
        found = [World(scenario, terrain) for scenario, terrains in worlds.items() for terrain in terrains]
    except (yaml.YAMLError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{path} must have 'worlds: {{scenario: [terrain, ...]}}': {one_line(error)}") from None
    if not found:
        raise ConfigError(f"{path} names no world; it must have 'worlds: {{scenario: [terrain, ...]}}'")
    return found


def held_out_scenarios() -> tuple[str, ...]:
    """What `all` means where scenarios are named: those of the held-out suite."""
    return tuple(dict.fromkeys(world.name for world in suite_worlds("held_out")))


# ---- one task --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Task:
    """One policy of one run in one world."""

    evaluation: Evaluation
    run_dir: Path
    policy: str
    world: World

    @property
    def walker(self) -> Path:
        """The run whose network moves the robot."""
        walker = self.evaluation.walker
        return walker if self.policy in DRIVEN and walker is not None else self.run_dir

    @cached_property
    def weights(self) -> str:
        """SHA-256 of the run's newest checkpoint."""
        return checksum(latest_checkpoint(self.run_dir))

    @cached_property
    def composed(self):
        """The configuration: the run's, or the walker's, in the world."""
        evaluation, overrides = self.evaluation, list(self.evaluation.overrides)
        if self.walker != self.run_dir:  # takes the overrides of robot and scene, and finds the presets
            overrides += config.as_override(config.search_path((), config.read(self.run_dir)))
            reach = (*_SCENE, "robot", "sim", "hydra")
            overrides = [str(o.input_line) for o in config.parse(overrides) if config.group_of(o) in reach]
        if not any(override.startswith("sim.num_threads=") for override in overrides):
            overrides.append("sim.num_threads=1")
        if self.world.terrain is not None:
            overrides.append(f"terrain={self.world.terrain}")
        if evaluation.condition is not None:
            overrides.append(f"condition={evaluation.condition}")
        if evaluation.split == "test":
            overrides += ["obstacles.split=test", f"seed={reported_seed(self.weights, self.world.name)}"]
        composed = config.load(
            self.walker, [f"scenario={self.world.name}", *overrides, f"num_envs={evaluation.num_envs}"]
        )
        if self.walker != self.run_dir and evaluation.condition is None:  # the run's own, whoever walks
            given = [o for o in config.parse(evaluation.overrides) if config.group_of(o) == "randomization"]
            own = config.load(self.run_dir, [*self._own_overrides(), *(str(o.input_line) for o in given)])
            OmegaConf.resolve(own)
            with open_dict(composed):
                for name in ("randomization", "condition"):
                    composed[name] = own.get(name)
        return composed

    def settings(self) -> dict:
        """What decides the outcomes, as the file says it."""
        condition = self.composed.get("condition") or {}
        return {
            "run": shown(self.run_dir),
            "policy": self.policy,
            "condition": condition.get("name", "none"),
            "world": self.world.name,
            "terrain": self.world.terrain or "own",
            "split": self.evaluation.split,
            "condition_version": condition.get("version", 0),
            "weights": self.weights,
            "seed": self.composed.seed,
            "walker": shown(self.walker),
            "walker_weights": self.weights if self.walker == self.run_dir else checksum(latest_checkpoint(self.walker)),
            "trials": self.evaluation.trials,
            "num_envs": self.evaluation.num_envs,
            "overrides": list(self.evaluation.overrides),
            "configuration": self._fingerprint(),
        }

    def _fingerprint(self) -> str:
        """SHA-256 of all that is configured, of the files that it names, and of trusted modules: they may change."""
        configs = self.composed, config.load(self.run_dir, self._own_overrides())
        texts = [OmegaConf.to_yaml(one, resolve=True) for one in configs]
        words = {event.value for text in texts for event in yaml.parse(text) if isinstance(event, yaml.ScalarEvent)}
        words |= {word.rpartition("#")[0] for word in words}  # of a mesh in a file the part before its name
        files = {os.path.expanduser(word) for word in words} | set(_sources(self.evaluation.trust))
        if self.policy == "exported":
            files.add(str(self.run_dir / EXPORTED / DESCRIPTION))
        texts += [checksum(Path(file)) for file in sorted(files) if os.path.isfile(file)]
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()

    @property
    def path(self) -> Path:
        """The file of the outcomes; that of the ways has another suffix."""
        world = self.world
        return self._file(world.name, world.terrain or "own", self.policy, f"{self.evaluation.trials}.json")

    @property
    def picture(self) -> Path:
        """The file of the worlds from above."""
        return self._file(self.policy, f"{self.evaluation.trials}.png")

    def _file(self, *names: str) -> Path:
        """A file of these settings alone; its last name has the suffix."""
        evaluation = self.evaluation
        others = [*evaluation.overrides, *([] if self.walker == self.run_dir else [f"walker={shown(self.walker)}"])]
        changes = [hashlib.sha256(" ".join(others).encode()).hexdigest()[:8]] if others else []
        stem = [evaluation.split, evaluation.condition or "own", *names[:-1], *changes, names[-1]]
        return self.run_dir / FOLDER / "-".join(stem)

    def done(self, facts: dict) -> Record | None:
        """The record of an earlier measurement by the same code with the same settings; None without one.

        Code that was changed since its commit is never the same: nothing says how it was changed.
        """
        kept = [self.path, *([self.path.with_suffix(".npz")] if self.evaluation.plots else [])]
        changed = (facts["commit"] or "").endswith(CHANGES)
        if changed or self.evaluation.again or not all(path.is_file() for path in kept):
            return None
        try:
            (record,) = read(self.path)
        except ConfigError:  # half a file, or one of another format
            return None
        now, before = self.settings() | {name: facts[name] for name in ("commit", "versions")}, record.plain()
        return record if all(before.get(name) == value for name, value in now.items()) else None

    def measure(self, facts: dict) -> Record:
        """Runs the trials and writes the files."""
        settings, trained = self.settings(), self._contender()
        env = trained.env
        episodes = run_episodes(env, trained.policy, self.evaluation.trials, keep_tracks=self.evaluation.plots)
        named = {name: settings.pop(name) for name in Record.__dataclass_fields__ if name in settings}
        settings |= {
            "what": POLICIES[self.policy],
            "checkpoint": shown(trained.checkpoint),
            "time_limit_s": env.config.terminations.episode_length_s,
            **({} if env.ground is None else {"tile_kinds": list(env.ground.kinds)}),
            **facts,
        }
        record = Record(**named, facts=settings, episodes=replace(episodes, tracks=None))
        ways = self.path.with_suffix(".npz")
        ways.unlink(missing_ok=True)  # those of an earlier measurement
        if episodes.tracks is not None:
            episodes.tracks.save(ways)
        write(self.path, [record])
        return record

    def assembled(self) -> RunConfig:
        """The environment's configuration, checked."""
        try:
            return build.assemble(self.composed, self.evaluation.trust)
        except ConfigError:
            build.check_version(self.walker, self.evaluation.trust)
            raise

    def check(self) -> None:
        """Builds it with one environment, so that what cannot be built is refused before hours of other tasks."""
        run = self.assembled()
        load_policy(replace(run, env=replace(run.env, num_envs=1)), self.walker)

    def _contender(self) -> TrainedPolicy:
        """The policy in a fresh environment of the world."""
        run = self.assembled()
        try:
            prepared_env = prepared(self.policy, run.env, self._own.lidar)
            trained = load_policy(replace(run, env=prepared_env), self.walker)
            if self.policy in BASELINES:
                avoidance = self._own.rewards.avoidance
                unlimited = self.walker == self.run_dir and avoidance.risk is not None
                limits = None if unlimited else commanded_ranges(self.walker)
                policy = baseline(self.policy, trained.env, trained.policy, avoidance, limits)
                return replace(trained, policy=policy)
            if self.policy == "exported":
                exported = ExportedPolicy.load(self.run_dir / EXPORTED)
                made_of = exported.description.provenance
                if made_of.get("weights") != self.weights:
                    raise ValueError(
                        f"it was exported from another checkpoint ({made_of.get('checkpoint')}) than the run's newest,"
                        f" {latest_checkpoint(self.run_dir).name}; export again"
                    )
                policy = ExportedPolicies(trained.env, exported)
                return replace(trained, policy=policy, checkpoint=self.run_dir / EXPORTED)
        except ValueError as error:
            raise ConfigError(f"policy={self.policy}: {error}") from None
        return trained

    @cached_property
    def _own(self) -> EnvConfig:
        """The run's task with the overrides, whoever walks: its LiDAR and its avoidance controller."""
        return build.load_run(self.run_dir, self._own_overrides(), self.evaluation.trust).env

    def _own_overrides(self) -> list[str]:
        """Those of the run, whatever world it is in."""
        parsed = config.parse(self.evaluation.overrides)
        return [str(override.input_line) for override in parsed if config.group_of(override) not in _SCENE]


def _sources(modules: Sequence[str]) -> Iterator[str]:
    """Files of Python modules, with what is below them."""
    for name in modules:
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None:
            yield spec.origin
        for folder in (spec and spec.submodule_search_locations) or ():
            yield from map(str, Path(folder).rglob("*.py"))


def reported_seed(weights: str, world: str) -> int:
    """Seed of the trials on the test split, which nobody can choose weights by: it follows from their hash."""
    first, count = _TEST_SEEDS
    return first + int(hashlib.sha256(f"{weights} {world}".encode()).hexdigest(), 16) % count


def shown(path: Path) -> str:
    """A path as it is written down: from the working directory, or its last two parts."""
    path, here = path.resolve(), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(Path(*path.parts[-2:]))


# ---- all tasks -------------------------------------------------------------------------------------------------------


def evaluate(evaluation: Evaluation) -> list[Record]:
    """Measures what has not been measured yet, prints progress and one table, and writes the files.

    Returns:
        A record for each task.
    """
    if evaluation.plots:
        check_figures()
    tasks, names = evaluation.tasks(), dict[str, Path]()
    for run_dir in (run_dir.resolve() for run_dir in evaluation.runs):
        if names.setdefault(shown(run_dir), run_dir) != run_dir:
            raise ConfigError(
                f"run={run_dir} and {names[shown(run_dir)]} would both be called {shown(run_dir)}; evaluate them from a"
                " folder above both"
            )
    if evaluation.out is not None and evaluation.out.exists():
        read(evaluation.out)  # refused before anything is measured
    records = measure_all(tasks)
    print(f"\n{(walking_table if all(record.episodes.walking for record in records) else table)(records)}")
    if evaluation.plots:
        _draw(tasks, records)
    if evaluation.out is not None:
        merge(evaluation.out, records)
        print(f"added to {evaluation.out}")
    return records


def measure_all(tasks: Sequence[Task]) -> list[Record]:
    """A record for each task: measured now, or before and kept. Prints progress and notes what is on the test split."""
    for run_dir in {task.run_dir for task in tasks}:
        latest_checkpoint(run_dir)  # a run without one is refused before anything is measured
        (run_dir / FOLDER).mkdir(exist_ok=True)
    paths = [task.path.resolve() for task in tasks]
    for k, task in enumerate(tasks):
        if paths.index(paths[k]) < k:
            raise ConfigError(f"run={task.run_dir} policy={task.policy} world={task.world.name} is given twice")
    device = tasks[0].assembled().env.sim.torch_device
    facts = provenance(device)
    records = {k: record for k, task in enumerate(tasks) if (record := task.done(facts)) is not None}
    if records:
        print(f"{len(records)} of {len(tasks)} measured before and kept; again=true measures them again", flush=True)
    left = {k: task for k, task in enumerate(tasks) if k not in records}
    jobs = tasks[0].evaluation.jobs or (default_num_threads() if device.type == "cpu" else 1)
    for k, record in _measured(left, facts, min(jobs, len(left))):
        records[k] = record
        print(f"[{len(records)}/{len(tasks)}] {progress_line(record)}", flush=True)
        if tasks[k].evaluation.split == "test":
            note(log_file(tasks[k].evaluation), record)
    return [records[k] for k in range(len(tasks))]


def _measured(tasks: Mapping[int, Task], facts: dict, jobs: int) -> Iterator[tuple[int, Record]]:
    """Numbers of the tasks with their records, in the order in which they end; an error once those begun have ended."""
    if jobs <= 1:
        for k, task in tasks.items():
            yield k, _in_worker(task, facts)
        return
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(_in_worker, task, facts): k for k, task in tasks.items()}
        failed: BaseException | None = None
        try:
            for future in as_completed(futures):
                if future.cancelled():
                    continue
                if (error := future.exception()) is None:
                    yield futures[future], future.result()
                    continue
                failed = failed or error
                for other in futures:
                    other.cancel()
        finally:
            pool.shutdown(cancel_futures=True)
        if failed is not None:
            raise failed


def _in_worker(task: Task, facts: dict) -> Record:
    """`measure` in one thread; errors are such that another process can raise them again."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return task.measure(facts)
    except ConfigError as error:
        raise ConfigError(str(error)) from None
    except CheckpointError as error:
        raise CheckpointError(str(error)) from None
    finally:
        torch.set_num_threads(before)


def log_file(evaluation: Evaluation) -> Path:
    """Where evaluations on the test split are noted."""
    if evaluation.log is not None:
        return evaluation.log
    return ROOT / LOG if (ROOT / ".git").exists() else evaluation.runs[0] / FOLDER / LOG.name


def note(log: Path, record: Record) -> None:
    """Appends a line about an evaluation on the test split."""
    facts = record.facts
    commit, _, changes = (facts["commit"] or "").partition("+")
    line = {
        "date": facts["date"],
        "commit": commit or None,
        "changes": bool(changes),
        **{name: facts[name] for name in ("command", "trials", "overrides", "versions")},
        **{name: getattr(record, name) for name in ("run", "weights", "policy", "world", "terrain", "condition")},
        "condition_version": record.condition_version,
        "seed": record.seed,
    }
    if not log.exists():
        log.parent.mkdir(parents=True, exist_ok=True)
        print(f"evaluations with split=test are noted in {log}", flush=True)
    with naming(log), open(log, "a") as file:
        file.write(json.dumps(line) + "\n")


def _draw(tasks: Sequence[Task], records: Sequence[Record]) -> None:
    """A picture of each policy of each run: all worlds from above, each on the first of its terrains."""
    panels: dict[Path, dict[str, Record]] = {}
    for task, record in zip(tasks, records, strict=True):
        episodes = replace(record.episodes, tracks=Tracks.load(task.path.with_suffix(".npz")))
        panels.setdefault(task.picture, {}).setdefault(record.world, replace(record, episodes=episodes))
    for path, worlds in panels.items():
        draw_worlds(path, list(worlds.values()))
        print(f"wrote {path}")
