"""Lists what a composed scene consists of and what was left out, each with the reason, without training.

    plan experiment=walk

A few environments are built, and what exists is listed. Every training run saves the same as plan.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from omniperception import build, config
from omniperception.cli import Command
from omniperception.plan import Plan, describe

BUILT_ENVS = 13
"""Environments that are built: few, and a number that no other dimension has."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command has overrides only."""


def main(_: Arguments, overrides: list[str]) -> None:
    """Prints the plan of a configuration."""
    print(plan_of(overrides).text())


def plan_of(overrides: list[str]) -> Plan:
    """The plan of a configuration."""
    run = build.assemble(config.compose(overrides))
    built = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, BUILT_ENVS)))
    return describe(run, build.build_runner(built, None))


command = Command(main, Arguments, __doc__, "of the configuration")
