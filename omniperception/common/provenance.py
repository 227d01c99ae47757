"""Provenance of a result: commit, command, date, machine, versions and seeds; part of every file of results."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

import torch

from omnirobot.common.errors import ConfigError
from omnirobot.common.files import write_whole

ROOT = Path(__file__).resolve().parents[2]
"""The checkout, or the folder that the package is installed in."""
FILE = "provenance.json"
"""Name of the file in a run directory that says where the run comes from."""
CHANGES = "+changes"
"""Follows the hash of a commit where files were changed since."""
LIBRARIES = ("omniperception", "torch", "mujoco-core", "warp-lang", "rsl-rl-lib", "tensordict", "numpy")


def provenance(device: object = "cpu", libraries: tuple[str, ...] = LIBRARIES, **facts: object) -> dict:
    """Commit, command, date, machine and versions of this process.

    Args:
        device: where tensors and rays live.
        libraries: distributions whose versions count; those that are not installed are left out.
        **facts: further entries, such as ``seed`` or ``threads``.
    """
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "command": command(),
        "machine": {
            "cpu": cpu_model(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "system": platform.system(),
            "device": device_name(str(device)),
            "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        },
        "versions": {"python": platform.python_version(), **versions(libraries)},
        **facts,
    }


def write(run_dir: Path, facts: Mapping) -> None:
    """Writes where a run comes from into its directory."""
    write_whole(run_dir / FILE, json.dumps(facts, indent=2) + "\n")


def read(run_dir: Path) -> dict:
    """What a run directory says of where the run comes from; empty: nothing. A ConfigError: nobody can read it."""
    path = run_dir / FILE
    try:
        return dict(json.loads(path.read_text("utf-8"))) if path.is_file() else {}
    except (ValueError, TypeError):
        raise ConfigError(f"{path} is damaged; delete it: it only says where the run comes from") from None


def made_at(run_dir: Path) -> str:
    """The commit that a run was made at, in words."""
    found = read(run_dir).get("commit")
    return f"commit {found}" if found else f"no commit is noted in {run_dir / FILE}"


@cache
def commit(root: Path = ROOT) -> str | None:
    """Hash of the commit that the code was run at, with CHANGES if files beside docs/ differed; None outside of a
    checkout."""
    if not (root / ".git").exists():
        return None
    try:
        found = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{found}{CHANGES}" if changed else found


def command() -> str:
    """The command line of this process; the program's path from the checkout's root, or its name alone."""
    program = Path(sys.argv[0] or "python")
    if program.name == "__main__.py":  # of python -m: a package is called as its folder
        program = program.parent
    path = program.resolve()
    name = str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else program.name
    return shlex.join([name, *sys.argv[1:]])


def versions(libraries: tuple[str, ...]) -> dict[str, str]:
    """Versions of the distributions that are installed."""
    found = {}
    for name in libraries:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def cpu_model() -> str:
    """The processor's name, with its family and model number where the name alone is ambiguous."""
    facts: dict[str, str] = {}
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        key, _, value = line.partition(":")
        facts.setdefault(key.strip(), value.strip())
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name} (family {facts['cpu family']} model {facts['model']})" if "cpu family" in facts else name


def device_name(device: str) -> str:
    """A GPU's name; "cpu" as it is."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()
