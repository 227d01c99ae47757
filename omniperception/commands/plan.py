"""Lists what a run consists of, and what it does without.

    plan experiment=walk
    plan experiment=walk beside=quickstart

A few environments are built and take a few steps; what then exists is listed with a +: physics, shapes of the rays,
terms, the state that was computed, stages of a step, kernels, imported modules, and memory. A - marks what exists in
the recipe `beside` and not here. Every training run saves its own as plan.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from omniperception import build, config
from omniperception.cli import Command, argument
from omniperception.plan import Plan, look

NUM_ENVS = 13
"""Environments that are built."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    beside: str | None = argument("paper", "experiment that it is compared with; null: none")


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Prints the plan of a configuration."""
    plan = plan_of(overrides)  # first, because modules that were imported stay
    folders = config.as_override(config.search_path(overrides))
    fuller = plan_of([*folders, f"experiment={arguments.beside}"]) if arguments.beside else None
    print(plan.text(fuller))


def plan_of(overrides: list[str]) -> Plan:
    """The plan of a configuration, built with few environments."""
    run = build.assemble(config.compose(overrides))
    few = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, NUM_ENVS)))
    return look(build.build_runner(few, None))


command = Command(main, Arguments, __doc__, "of the configuration")
