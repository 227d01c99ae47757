"""What a composed scene consists of and what was left out, each with the reason, without training.

    python scripts/plan.py [overrides as for train.py]

A few environments are built, and what exists is listed. Every training run saves the same as plan.yaml.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from omniperception import config
from omniperception.assembly import build_runner
from omniperception.plan import Plan, describe

BUILT_ENVS = 13
"""Environments that are built: few, and a number that no other dimension has."""


def plan_of(overrides: list[str]) -> Plan:
    """The plan of a command line."""
    run = config.assemble(config.compose(overrides))
    built = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, BUILT_ENVS)))
    return describe(run, build_runner(built, None))


def main() -> None:
    with config.one_line_errors():
        print(plan_of(sys.argv[1:]).text())


if __name__ == "__main__":
    main()
