"""Lists what a run consists of, and what it does without.

    plan experiment=walk beside=quickstart

What is built is listed with a +, what is left out, or what only the recipe `beside` has, with a -.
"""

from dataclasses import dataclass, replace

from omniperception import build, config
from omniperception.plan import parts_of
from omnirobot.common.cli import Command, argument


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    beside: str | None = argument("paper", "experiment that it is compared with; null: none")


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Prints the parts of a configuration."""
    parts, folders = build_parts(overrides), config.as_override(config.search_path(overrides))
    fuller = build_parts([*folders, f"experiment={arguments.beside}"]) if arguments.beside else {}
    for name in {**parts, **fuller}:
        own = parts.get(name, [])
        missing = [item for item in fuller.get(name, []) if item not in own]
        if own:
            print(f"+ {name}: {', '.join(own)}")
        if missing or not own:
            print(f"- {name}: {', '.join(missing)}".rstrip(": "))


def build_parts(overrides: list[str]) -> dict[str, list[str]]:
    """The parts of a configuration, built with few environments."""
    run = build.assemble(config.compose(overrides))
    few = replace(run.env, num_envs=min(run.env.num_envs, 13))
    return parts_of(build.build_runner(replace(run, env=few), None))


command = Command(main, Arguments, __doc__, "of the configuration")
