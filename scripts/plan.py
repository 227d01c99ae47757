"""What a composed scene consists of and what was left out, each with the reason, without training.

    python scripts/plan.py [overrides as for train.py]
    python scripts/plan.py what=gain [scene=all|walk|quickstart|camera|everything] [num_envs=256] [repeats=9]

A few environments are built, and what exists is listed. Every training run saves the same as plan.yaml. `what=gain`
measures what it would cost to have what is left out: step, memory and start-up with each thing forced in.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.plan import Plan, describe

BUILT_ENVS = 13
"""Environments that are built: few, and a number that no other dimension has."""


def plan_of(overrides: list[str]) -> Plan:
    """The plan of a command line."""
    run = build.assemble(config.compose(overrides))
    built = replace(run, env=replace(run.env, num_envs=min(run.env.num_envs, BUILT_ENVS)))
    return describe(run, build_runner(built, None))


def print_gain(arguments: list[str]) -> None:
    """Tables of what forcing things in costs, each scene's as soon as it is measured."""
    from benchmarks import pruning_benchmark as benchmark

    own, rest = config.split_arguments(arguments, {"scene": "all", "num_envs": "256", "repeats": "9"})
    if rest:
        raise config.ConfigError(f"what=gain takes scene, num_envs and repeats, not {rest[0]}")
    num_envs, repeats = (int(config.positive(key, own[key], int)) for key in ("num_envs", "repeats"))
    scenes = tuple(benchmark.SCENES) if own["scene"] == "all" else (own["scene"],)
    print("\n".join(benchmark.step_header(num_envs)))
    for scene in scenes:
        print("\n".join(map(benchmark.step_row, benchmark.measure(scene, num_envs, repeats))), flush=True)
    print("\n".join(("", *benchmark.START_HEADER)))
    for scene in scenes:
        print(benchmark.start_row(*benchmark.start_up(scene, num_envs, min(repeats, 3))), flush=True)


def main() -> None:
    with config.one_line_errors():
        own, rest = config.split_arguments(sys.argv[1:], {"what": "plan"})
        if own["what"] not in ("plan", "gain"):
            raise config.ConfigError(f"what={own['what']} must be plan or gain")
        if own["what"] == "gain":
            print_gain(rest)
        else:
            print(plan_of(rest).text())


if __name__ == "__main__":
    main()
