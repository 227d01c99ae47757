"""Writes a guessed preset as YAML that a person can read, with how each value was found."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from pathlib import Path

import yaml

from omniperception.robots.guess import Guess

WIDTH = 118


def text_of(guess: Guess, file: Path) -> str:
    """The preset; a comment above a key says how sure its value is and why."""
    said = {key: finding for finding in guess.findings for key in finding.key.split(", ")}
    lines = [f"# Robot of {file.name}, written by `omniperception robot-new`. What is marked guess deserves a look."]
    for note in guess.notes:
        lines += _wrapped(note)
    for key, value in guess.preset.items():
        if key in said:
            lines += _wrapped(f"{said[key].how_sure}: {said[key].why}")
        lines += _shown(key, value)
    return "\n".join(lines) + "\n"


def table_of(guess: Guess) -> str:
    """What was found, how sure it is, and why, one line each."""
    width = max(len(finding.key) for finding in guess.findings)
    rows = [f"  {finding.key:<{width}}  {finding.how_sure:<6}  {finding.why}" for finding in guess.findings]
    return "\n".join([*rows, *(f"note: {note}" for note in guess.notes)])


def _wrapped(text: str) -> list[str]:
    """A comment, broken into lines."""
    return textwrap.wrap(
        text, WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False, break_on_hyphens=False
    )


def _shown(key: str, value: object) -> list[str]:
    """A key: lists in lines of their width, mappings and lists of lists with a line for each item."""
    if isinstance(value, Mapping):
        return [f"{key}:", *(line for name, item in value.items() for line in _item(f"  {_name(name)}: ", item))]
    if isinstance(value, list) and value and isinstance(value[0], list):
        return [f"{key}:", *(line for item in value for line in _item("  - ", item))]
    return _item(f"{key}: ", value)


def _name(name: str) -> str:
    """A key, quoted where YAML would read it as something else."""
    return yaml.safe_dump(name, width=math.inf).removesuffix("\n").removesuffix("\n...")


def _item(head: str, value: object) -> list[str]:
    """Plain data in YAML's short form, after its head."""
    dumped = yaml.safe_dump(
        value,
        default_flow_style=True,
        width=WIDTH - 38,  # a line ends after the item that passes this
        sort_keys=False,
    )
    first, *rest = dumped.removesuffix("\n").removesuffix("\n...").splitlines()
    indent = " " * (len(head) - len(head.lstrip()) + 2)
    return [head + first, *(indent + line.strip() for line in rest)]
