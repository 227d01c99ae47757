"""Trains runs: begins, goes on with one, and says what it begins with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from omniperception import build, config
from omniperception.common import provenance
from omniperception.common.checkpoints import checkpoint_path
from omniperception.learning import distributed, latest_checkpoint
from omniperception.learning.ppo import check_rollout
from omniperception.learning.progress import say
from omniperception.plan import parts_of, summary
from omniperception.schema import words_of
from omnirobot.common.files import try_lock
from omnirobot.common.shell import command_line

_OF_A_BEGINNING = ("seed", "init", "ppo.critic_warmup", "ppo.init_std", "ppo.start_std")


def go_on(run_dir: Path, overrides: Sequence[str], trust: Sequence[str]) -> None:
    """Goes on with a run; what overrides change is written into its directory, for whoever reads it next."""
    for override in config.parse(overrides):
        if override.key_or_group in _OF_A_BEGINNING:
            raise config.ConfigError(
                f"{override.input_line}: {run_dir} has begun already and goes on from its newest checkpoint; leave it"
                " out, or train a run of its own"
            )
    run = _trainable(build.load_run(run_dir, overrides, trust))
    if run.ppo.schedule == "adaptive":
        for override in config.parse(overrides):
            if override.key_or_group == "ppo.learning_rate":
                raise config.ConfigError(
                    f"{override.input_line}: ppo.schedule=adaptive goes on from the checkpoint's; leave it out, or give"
                    " ppo.schedule=fixed with it"
                )
    with _exclusive_run_dir(run_dir):
        learn(run, run_dir, resume=True, changes=overrides, trust=trust)


def assemble(composed: DictConfig) -> build.RunConfig:
    """Builds and validates a run that may be trained; see `build.assemble`.

    Raises:
        ConfigError: it would see obstacles of the test split, or gives noise to a policy that nothing begins with.
        LoggerError: a library is missing.
    """
    run = build.assemble(composed)
    if run.ppo.start_std is not None and not run.init:
        raise config.ConfigError(
            f"ppo.start_std={run.ppo.start_std} is of a policy that another run gives (init=); give ppo.start_std=null,"
            " and ppo.init_std for the noise of a new one"
        )
    return _trainable(run)


def _trainable(run: build.RunConfig) -> build.RunConfig:
    """Refuses a run that would see obstacles of the test split, or whose logger lacks its library."""
    build.check_split(run, "training")
    run.family_envs()
    if run.logger is not None:
        run.logger.check()
    return run


def train(composed: DictConfig, run_dir: Path, overrides: Sequence[str], trust: Sequence[str] = ()) -> None:
    """Trains the configuration that overrides composed, in its directory."""
    run = assemble(composed)
    distributed.connect(run.env.sim.torch_device)
    own, run_dir = run_dir, distributed.of_first(run_dir)
    if own != run_dir:  # another process made it a second earlier
        with suppress(OSError):
            own.rmdir()
    begun = distributed.of_first(config.is_begun(run_dir, run.composed))
    if not begun:
        _check_sources(run)
        ppo = run.ppo
        check_rollout(run.env.num_envs, ppo.num_steps_per_env, ppo.num_mini_batches, run.perception is not None)
    with _exclusive_run_dir(run_dir):
        begun = distributed.of_first(config.is_begun(run_dir, run.composed))  # another process may have ended meanwhile
        if distributed.rank() == 0:
            config.save(run.composed, run_dir)
            if not begun:
                provenance.write(run_dir, provenance.provenance(run.env.sim.torch_device, seed=run.env.seed))
                config.save_recipe(overrides, run_dir)
        learn(run, run_dir, resume=begun, trust=trust)


@contextmanager
def _exclusive_run_dir(run_dir: Path) -> Iterator[None]:
    """Refuses to train in a directory in which another process trains: it holds the folder of the checkpoints."""
    if distributed.rank() > 0:
        yield
        return
    checkpoints = checkpoint_path(run_dir, 0).parent
    try:
        checkpoints.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise config.ConfigError(
            f"{run_dir} cannot be written: {error.strerror}; choose another hydra.run.dir"
        ) from None
    with try_lock(checkpoints) as alone:
        if not alone:
            raise config.ConfigError(f"{run_dir}: another process trains there; wait for its end, or stop it and go on")
        yield


def _check_sources(run: build.RunConfig) -> None:
    """Refuses runs to begin from that have no weights, or moved otherwise, before a directory is written."""
    if run.init and run.env.sim.has_legs:
        _check_motion(OmegaConf.create(run.composed), run.init[-1])
    for name in run.init:
        latest_checkpoint(config.find_run(name, "init"))
    if run.distillation is not None:
        latest_checkpoint(config.find_run(run.distillation.teacher, "distillation.teacher"))


def learn(
    run: build.RunConfig, run_dir: Path, resume: bool, changes: Sequence[str] = (), trust: Sequence[str] = ()
) -> None:
    """Trains a run to its end in `run_dir`; of several processes the first one reports.

    Args:
        run: the configuration.
        run_dir: its directory.
        resume: whether it goes on from its newest checkpoint.
        changes: overrides of what it was before.
        trust: packages of one's own whose names the configurations of `init` and the teacher may build.
    """
    torch.set_flush_denormal(True)  # gradients of faint activations are, and one convolution took 40 times as long
    runner, composed = build.build_runner(run, run_dir), OmegaConf.create(run.composed)
    if resume:
        if not runner.load(latest_checkpoint(run_dir)):
            report("its task is another now: new episodes begin")
        if changes and distributed.rank() == 0:  # the weights fit
            config.save(run.composed, run_dir)
            config.save_recipe([*config.read_recipe(run_dir), *changes], run_dir)
        report(f"resuming {run_dir} after {runner.current_learning_iteration} iterations")
    else:
        if run.init:
            given = [config.find_run(name, "init") for name in run.init]
            theirs = build.load_run(given[-1], trust=trust)
            seeing = runner.start_from(*given, observations=theirs.env.observations)
            for source in seeing:
                _report_other_sampler(composed, source)
            if run.perception is not None and theirs.perception is not None and not seeing:
                report(f"init={given[-1]}: its perception or its read-out has another form, and both stay behind")
            _report_other_terms(composed, given[-1], "init")
        report(f"run directory: {run_dir}")
    if run.distillation is not None and runner.current_learning_iteration < run.distillation.iterations:
        name, key = run.distillation.teacher, "distillation.teacher"
        teacher = config.find_run(name, key)
        _check_motion(composed, name, key)
        _report_other_terms(composed, teacher, key)
        runner.alg.learn_from(build.load_teacher(teacher, runner.env, trust))

    report(summary(parts_of(runner), run.families))
    if distributed.rank() == 0 and run.logger is not None and run.logger.video_interval is not None:
        from omniperception.evaluation.film.training_videos import TrainingVideos

        videos = TrainingVideos(runner, run_dir, run.logger.video_interval, run.logger.video_s)
        runner.step_hooks.append(videos.step)
        runner.end_hooks.append(videos.close)
    runner.learn(max(run.ppo.max_iterations - runner.current_learning_iteration, 0), init_at_random_ep_len=not resume)
    play = command_line("play", *words_of(run_dir, run.composed))
    report(f"{runner.stop_reason}: {runner.current_learning_iteration} iterations; next: {play}")
    distributed.disconnect()


def _check_motion(composed: DictConfig, source: str, name: str = "init") -> None:
    """Refuses weights whose actions meant another motion in the run that they come from; nothing in them shows it."""
    other = config.read(config.find_run(source, name))
    robots = [OmegaConf.select(one, "robot.file") for one in (composed, other)]
    for key in ("stepping", "robot.joints", "robot.default_joint_pos", "robot.action_scale"):
        own, given = OmegaConf.select(composed, key), OmegaConf.select(other, key)
        if own != given:
            if robots[0] != robots[1]:
                raise config.ConfigError(
                    f"{name}={source}: it moves the robot of {robots[1]}, this one is that of {robots[0]}, and {key}"
                    f" differs; give {name}=<a run with this robot>, such as one of experiment=gait"
                )
            wanted = "null" if given is None else str(given).replace("'", "").replace(": ", ":")
            raise config.ConfigError(
                f"{name}={source}: its actions meant another motion, that of '{key}={wanted}'; give the same here"
            )
    if robots[0] != robots[1]:
        report(f"{name}={source}: it was learned by the robot of {robots[1]}, this one is that of {robots[0]}")


def _report_other_sampler(composed: DictConfig, source: Path) -> None:
    """Says where a perception network goes on with inputs that are made otherwise; nothing in its weights shows it."""
    changes = _changes(*(one.perception.sampler for one in (config.read(source), composed)))
    if changes:
        report(f"init={source}: its perception was learned from another sampler ({changes}) and goes on from there")


def _report_other_terms(composed: DictConfig, source: Path, name: str) -> None:
    """Says where what a policy observes has other parameters, such as a scale, than in the run that it comes from."""
    own, given = (_terms(one) for one in (composed, config.read(source)))
    for term, parameters in own.items():
        if term in given and (changes := _changes(given[term], parameters)):
            report(f"{name}={source}: what it observes as {term} is made otherwise here ({changes})")


def _terms(composed: DictConfig) -> dict[str, DictConfig]:
    """Parameters of the terms that the actor observes."""
    groups = [composed.observations.groups[name] for name in composed.observations.actor]
    return {
        str(term): parameters for group in groups for term, parameters in group.terms.items() if parameters is not None
    }


def _changes(before: DictConfig, now: DictConfig) -> str:
    keys = [key for key in dict.fromkeys((*before, *now)) if before.get(key) != now.get(key)]
    return ", ".join(f"{key} {before.get(key)} -> {now.get(key)}" for key in keys)


def report(text: str) -> None:
    """Prints a line, once however many processes learn."""
    if distributed.rank() == 0:
        say(text)
