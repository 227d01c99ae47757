"""Studies: the same training with several networks, ways of training and seeds, evaluated, and tables of it."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import yaml

from omniperception import build, config
from omniperception.config import ConfigError
from omniperception.evaluation.report.pages import by_training
from omniperception.evaluation.report.records import Record, read, write
from omniperception.evaluation.report.studies import study_table
from omniperception.evaluation.suite import (
    Evaluation,
    Task,
    World,
    held_out_scenarios,
    measure_all,
    suite_worlds,
)
from omniperception.evaluation.trials.policies import POLICIES, SPLITS
from omnirobot.common.errors import check_known, one_line
from omnirobot.common.files import write_whole
from omnirobot.common.signals import interruptible

_NO_PROXIMAL = ("perception.height_weight=0", "perception.sampler.num_proximal=0", "perception.network.proximal_dim=0")
_NO_DISTAL = ("perception.sampler.num_distal=0", "perception.network.distal_dim=0")
VARIANTS: dict[str, tuple[str, ...]] = {
    "pd_risknet_no_proximal": ("perception=pd_risknet", *_NO_PROXIMAL),
    "pd_risknet_no_distal": ("perception=pd_risknet", *_NO_DISTAL),
    "proximity_gru_no_proximal": ("perception=proximity_gru", *_NO_PROXIMAL),
    "polar_rings_no_match": ("perception=polar_rings", "perception.network.rings.match=null"),
}
"""Overrides of the variants that are no presets of `perception`; what the perception is supervised with is the
experiment's."""
RESULTS = "results.json.gz"


@dataclass(frozen=True)
class Arm:
    """A way of training.

    Attributes:
        overrides: of the study's experiment, after those of the study; those of the command line replace them.
        after: the arm whose weights, of the same network and seed, this one begins with (`init`); None: none.
    """

    overrides: Sequence[str] = ()
    after: str | None = None


@dataclass(frozen=True)
class Study:
    """What is trained and evaluated; a file of conf/study has these names.

    Attributes:
        experiment: the recipe that all trainings share.
        variants: perception presets, or names from VARIANTS.
        seeds: one run of each variant and arm for each.
        scenarios: names from conf/scenario, on their own terrain; none where there is a suite.
        suite: file of conf/suite, whose worlds take the place of scenarios.
        trials: of each run in each scenario.
        arms: ways of training by name; one that begins with the weights of another stands behind it.
        overrides: of the experiment, that all arms share.
        conditions: presets of `condition`.
        policies: names from `trials.policies.POLICIES`.
        split: dev or test.
    """

    experiment: str
    variants: Sequence[str]
    seeds: Sequence[int]
    trials: int
    scenarios: Sequence[str] = ()
    suite: str | None = None
    arms: Mapping[str, Arm] = field(default_factory=lambda: {"own": Arm()})
    overrides: Sequence[str] = ()
    conditions: Sequence[str] = ("ideal",)
    policies: Sequence[str] = ("run",)
    split: str = "dev"

    def __post_init__(self) -> None:
        if len(set(self.seeds)) < len(self.seeds):
            raise ConfigError(f"seeds={','.join(map(str, self.seeds))} names one twice; each is one run")
        if bool(self.scenarios) == (self.suite is not None):
            given = f"scenarios={','.join(self.scenarios)} and suite={self.suite}" if self.suite else "neither"
            raise ConfigError(f"a study has either scenarios or a suite, got {given}")
        before: set[str] = set()
        for name, arm in self.arms.items():
            if arm.after is not None and arm.after not in before:
                raise ConfigError(f"arms.{name}.after={arm.after} must be an arm before it, one of {sorted(before)}")
            before.add(name)
        check_known("split", [self.split], tuple(SPLITS))
        check_known("policies", self.policies, tuple(POLICIES))


def load_study(name: str, folders: Sequence[Path] = ()) -> Study:
    """The study of a file of conf/study."""
    path = config.listed(config.STUDIES, name, folders)
    try:
        given = dict(yaml.safe_load(path.read_text()) or {})
        if "arms" in given:
            given["arms"] = {arm: Arm(**settings) for arm, settings in given["arms"].items()}
        return Study(**given)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ConfigError(f"{path} is no study: {one_line(error)}") from None


@dataclass(frozen=True)
class Ablation:
    """A study in a folder.

    Attributes:
        study: what is trained and evaluated.
        out: its folder; runs lie in <out>/<arm>/<variant>/seed<seed>.
        overrides: of every training, Hydra's own (such as hydra/launcher=submitit_slurm) included.
        trust: packages of one's own whose names the configuration may build.
    """

    study: Study
    out: Path
    overrides: Sequence[str] = ()
    trust: Sequence[str] = ()

    def __post_init__(self) -> None:
        folders = config.search_path(self.overrides)
        check_known("variants", self.study.variants, (*VARIANTS, *config.presets("perception", folders)))
        check_known("conditions", self.study.conditions, config.presets("condition", folders))
        if "all" in self.study.scenarios and len(self.study.scenarios) > 1:
            raise ConfigError("scenarios=all has every scenario of held_out; leave the others out")
        check_known("scenarios", self.study.scenarios, (*config.presets("scenario", folders), "all"))
        if self.study.suite is not None:
            suite_worlds(self.study.suite, folders)
        arms = self.study.arms.values()
        own = config.parse([*self.study.overrides, *(text for arm in arms for text in arm.overrides)])
        given = config.parse(self.overrides)
        fixed = {o.key_or_group for variant in self.study.variants for o in config.parse(overrides_of(variant))}
        for override in (*own, *given):
            if override.key_or_group in ("experiment", "seed", *fixed):
                raise ConfigError(
                    f"{override.input_line}: experiment=, seeds= and variants= of the study say this; leave it out"
                )
        if any(override.key_or_group == "init" for override in given) and any(arm.after for arm in arms):
            raise ConfigError("init is given, and an arm of the study begins where another has ended; leave it out")

    def run_dir(self, arm: str, variant: str, seed: int) -> Path:
        return self.out / arm / variant / f"seed{seed}"

    def run_dirs(self) -> list[Path]:
        """All of them, seeds of a training one after the other."""
        study = self.study
        trainings = itertools.product(study.arms, study.variants, study.seeds)
        return [self.run_dir(*training) for training in trainings]

    def worlds(self) -> list[World]:
        if self.study.suite is not None:
            return suite_worlds(self.study.suite, config.search_path(self.overrides))
        names = self.study.scenarios
        return [World(name) for name in (held_out_scenarios() if list(names) == ["all"] else names)]


def train(ablation: Ablation) -> None:
    """Trains what is missing, arm by arm, a sweep over the seeds for each variant.

    Stopped runs go on, finished ones are left alone. With a launcher of Hydra's (a cluster) the variants of an arm are
    trained at the same time, otherwise one after the other.

    Raises:
        ConfigError: a training failed.
    """
    together = any(override.startswith("hydra/launcher=") for override in ablation.overrides)
    variants = ablation.study.variants
    for arm in ablation.study.arms:
        for group in [variants] if together else [[variant] for variant in variants]:
            with _ended_with_this_process() as running:
                running += [subprocess.Popen(_sweep(ablation, arm, variant)) for variant in group]
                for process in running:
                    if process.wait():
                        code = process.returncode
                        raise ConfigError(f"training ended with exit code {code}; the same command goes on from there")


@contextmanager
def _ended_with_this_process() -> Iterator[list[subprocess.Popen]]:
    """Trainings that are waited for; when this process is told to end, so are they, and save first."""
    running: list[subprocess.Popen] = []
    with interruptible():
        try:
            try:
                yield running
            except Exception:  # one has failed; the others go on to their end
                for process in running:
                    process.wait()
                raise
        except KeyboardInterrupt:
            for process in running:
                process.terminate()
            for process in running:
                process.wait()
            raise


def _sweep(ablation: Ablation, name: str, variant: str) -> list[str]:
    """Command of a training over the seeds."""
    study = ablation.study
    return [
        *(sys.executable, "-m", "omniperception", "train", "-m"),
        *_training(ablation, name, variant),
        f"seed={','.join(map(str, study.seeds))}",
        f"hydra.sweep.dir={config.quoted(str(ablation.out))}",
        f"hydra.sweep.subdir={name}/{variant}/seed${{seed}}",
        *([f"trust={','.join(ablation.trust)}"] if ablation.trust else []),
    ]


def _training(ablation: Ablation, name: str, variant: str) -> list[str]:
    """What an arm says of a variant's trainings: the study's overrides, then the arm's, then the command line's."""
    study, arm = ablation.study, ablation.study.arms[name]
    before = config.quoted(f"{ablation.out}/{arm.after}/{variant}/seed${{seed}}")
    after = [] if arm.after is None else [f"init={before}"]
    chosen: dict[str, str] = {}
    for texts in (study.overrides, after, arm.overrides, ablation.overrides):  # the later ones win
        for override in config.parse(texts):
            chosen.pop(override.key_or_group, None)  # so that it comes last
            chosen[override.key_or_group] = str(override.input_line)
    return [f"experiment={study.experiment}", *overrides_of(variant), *chosen.values()]


def check_trainings(ablation: Ablation) -> None:
    """Composes and validates a training of each variant in each arm, before the first of them is started."""
    for arm in ablation.study.arms:
        for variant in ablation.study.variants:
            settings = [*_training(ablation, arm, variant), f"seed={ablation.study.seeds[0]}"]
            build.assemble(config.compose(settings))


def overrides_of(variant: str) -> tuple[str, ...]:
    """Overrides of a variant: a preset of `perception`, or one of VARIANTS."""
    return VARIANTS.get(variant, (f"perception={variant}",))


def _tasks(ablation: Ablation) -> list[Task]:
    """Every run in every world, a condition after the other.

    Raises:
        ConfigError: a run has not been trained.
    """
    study, worlds, runs = ablation.study, ablation.worlds(), ablation.run_dirs()
    for run_dir in runs:
        if not run_dir.is_dir():
            raise ConfigError(f"{run_dir} has not been trained; use stage=train or stage=all")
    same = Evaluation(
        runs, worlds, policies=study.policies, split=study.split, trials=study.trials, trust=tuple(ablation.trust)
    )
    return [task for condition in study.conditions for task in replace(same, condition=condition).tasks()]


def evaluate_all(ablation: Ablation) -> None:
    """Evaluates every run in every scenario, but for what the same code has evaluated at the same checkpoint before."""
    measure_all(_tasks(ablation))


def write_tables(ablation: Ablation) -> str:
    """Writes the results, trial by trial, and ablation.md into the study's folder; the latter's text.

    Of a suite's many worlds it has a table of all of them first.

    Raises:
        ConfigError: a run has not been evaluated in a scenario with its newest checkpoint.
    """
    records = [replace(_found(task), run=str(task.run_dir.relative_to(ablation.out))) for task in _tasks(ablation)]
    text = study_table(records)
    if ablation.study.suite is not None:
        text = f"{by_training(records)}\n\n{text}"
    write(ablation.out / RESULTS, records)
    write_whole(ablation.out / "ablation.md", text)
    return text


def _found(task: Task) -> Record:
    """What `evaluate_all` has measured."""
    for record in read(task.path) if task.path.is_file() else []:
        if len(record.episodes) == task.evaluation.trials and record.weights == task.weights:
            return record
    raise ConfigError(
        f"{task.run_dir} has not been evaluated in {task.world.name} with condition={task.evaluation.condition}"
        f" policy={task.policy} trials={task.evaluation.trials} and its newest checkpoint; use stage=evaluate or"
        " stage=all"
    )
