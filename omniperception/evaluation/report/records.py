"""Results as files: what one policy did in one world under one condition, trial by trial, with its provenance."""

from __future__ import annotations

import gzip
import json
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omniperception.config import ConfigError
from omniperception.evaluation.trials.outcomes import Episodes
from omnirobot.common.files import lock, write_whole

FORMAT = 1
FOLDER = "evaluation"
"""Folder of a run directory for the results."""
_KEY = ("run", "policy", "condition", "world", "terrain", "split")
_NAMED = (*_KEY, "condition_version", "weights", "seed")


@dataclass(frozen=True)
class Record:
    """Trials of one policy in one world.

    Attributes:
        policy: name in `trials.policies.POLICIES`.
        world: preset of `scenario`.
        terrain: preset of `terrain`; "own" for what the scenario says.
        condition: preset of `condition`; "none" where randomization was chosen otherwise.
        condition_version: its version; 0 without one.
        split: dev or test: which obstacles, and which seed.
        run: run directory, as far as it says anything on another machine.
        weights: SHA-256 of the run's checkpoint.
        seed: of the trials.
        facts: everything else that is written down: overrides, checkpoint, date, commit, command, machine, versions.
        episodes: the outcomes.
    """

    policy: str
    world: str
    terrain: str
    condition: str
    condition_version: int
    split: str
    run: str
    weights: str
    seed: int
    facts: dict[str, Any] = field(repr=False)
    episodes: Episodes = field(repr=False)

    @property
    def key(self) -> tuple[str, ...]:
        """What tells it from the others of a file."""
        return (*(getattr(self, name) for name in _KEY), *self.changes)

    @property
    def changes(self) -> tuple[str, ...]:
        """What was not the run's own: the gait, and overrides."""
        walker = self.facts.get("walker", self.run)
        return (*(() if walker == self.run else (f"walker={walker}",)), *self.facts.get("overrides", ()))

    @property
    def training(self) -> str:
        """The training that the run belongs to."""
        return training_of(self.run)

    @property
    def chosen_terrain(self) -> str:
        """The terrain, where an override chose it, too: `evaluate scenario=all terrain=flat` has no suite to say so."""
        chosen = [text.partition("=")[2] for text in self.facts.get("overrides", ()) if text.startswith("terrain=")]
        return chosen[-1] if chosen and self.terrain == "own" else self.terrain

    @property
    def place(self) -> str:
        """World and terrain, in words."""
        terrain = self.chosen_terrain
        return self.world if terrain in ("own", "flat") else f"{self.world}, {terrain}"

    def plain(self) -> dict:
        """As it is written; `of` reads it."""
        return {
            **{name: getattr(self, name) for name in _NAMED},
            **self.facts,
            "us_per_env_step": {stage: round(us, 1) for stage, us in self.episodes.us_per_env_step.items()},
            "outcomes": self.episodes.columns(),
        }

    @classmethod
    def of(cls, plain: dict) -> Record:
        """A record that `plain` wrote."""
        rest = dict(plain)
        named = {name: rest.pop(name) for name in _NAMED}
        episodes = Episodes.from_columns(rest.pop("outcomes"), rest.pop("us_per_env_step"))
        return cls(**named, facts=rest, episodes=episodes)


def training_of(run: str) -> str:
    """The training that a run belongs to: one in a folder seed<n> is a seed of what the folder above names."""
    path = Path(run)
    return str(path.parent if re.fullmatch(r"seed\d+", path.name) else path)


def write(path: Path, records: Iterable[Record]) -> None:
    """Writes records to a .json file, or compressed to a .json.gz; the same records give the same bytes."""
    lines = ",\n".join(json.dumps(record.plain(), separators=(",", ":")) for record in records)
    text = f'{{"format": {FORMAT}, "records": [\n{lines}\n]}}\n'.encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, gzip.compress(text, mtime=0) if path.suffix == ".gz" else text)


def read(path: Path) -> list[Record]:
    """The records of a file that `write` wrote.

    Raises:
        ConfigError: it is none.
    """
    try:
        raw = path.read_bytes()
        content = json.loads(gzip.decompress(raw) if path.suffix == ".gz" else raw)
        if content["format"] != FORMAT:
            raise ConfigError(f"{path} has format {content['format']}, this version reads {FORMAT}; evaluate again")
        return [Record.of(plain) for plain in content["records"]]
    except ConfigError:
        raise
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} holds no results of evaluate ({error!r}); delete it, or give another") from None


def merge(path: Path, records: Sequence[Record]) -> None:
    """Adds records to a file, to which other processes may add theirs; those that measured the same are replaced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with lock(path.parent):
        kept = {record.key: record for record in (read(path) if path.exists() else [])}
        write(path, (kept | {record.key: record for record in records}).values())
