"""Exports a run's newest policy for a robot or another simulator.

    export run=latest

Writes into exported/ in the run directory, or into `out`:

    policy.onnx    the network as ONNX: observations, sampled frames and their number -> actions
    policy.pt      the same as TorchScript
    policy.json    names, scales, rates, layout of the observations, sampling, mount of the sensor, provenance
    deploy.yaml    what of it unitree_rl_lab's form has a place for; of a Go2

omnirobot.runtime.ExportedPolicy runs it, with sampling and history, from raw points, joint states and IMU.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.deploy.deploy_yaml import FILE as DEPLOY_YAML
from omniperception.deploy.export import FOLDER, FORMATS, export
from omnirobot.common.cli import Command, argument, trust


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    out: Path | None = argument(None, "folder of what is written; null: exported/ in the run directory")
    formats: tuple[str, ...] = argument(tuple(FORMATS), "which networks are written", choices=tuple(FORMATS))
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments) -> None:
    """Exports, and prints what was written."""
    run_dir = config.find_run(arguments.run)
    folder = arguments.out or run_dir / FOLDER
    if folder.exists() and not folder.is_dir():
        raise config.ConfigError(f"out={folder} is a file; give a folder")
    described = export(run_dir, folder, arguments.formats, arguments.trust)
    inputs = ", ".join(f"{name} {list(shape)}" for name, shape in described.inputs.items())
    print(f"{described.provenance['checkpoint']}: {inputs} -> {len(described.joints.names)} actions")
    lidar = f"LiDAR {1 / described.lidar.period_s:g} Hz" if described.lidar else "blind"
    print(f"control {1 / described.control_period_s:g} Hz, {lidar}")
    written = [*described.files.values(), "policy.json", *([DEPLOY_YAML] if (folder / DEPLOY_YAML).is_file() else [])]
    print(f"wrote {', '.join(str(folder / name) for name in written)}")


command = Command(main, Arguments, __doc__)
