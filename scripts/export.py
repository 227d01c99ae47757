"""Exports a run's newest policy for a robot or another simulator.

python scripts/export.py run=latest [out=<folder>] [formats=onnx,torchscript]

Writes into exported/ in the run directory, or into `out`:
    policy.onnx    the network as ONNX: observations, sampled frames and their number -> actions
    policy.pt      the same as TorchScript
    policy.json    names, scales, rates, layout of the observations, sampling, mount of the sensor, provenance
omniperception.deploy.ExportedPolicy runs it, with sampling and history, from raw points, joint states and IMU.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from omniperception import config
from omniperception.deploy import Description
from omniperception.deploy.export import FORMATS, Export, export
from omniperception.deploy.modules import ExportUnavailable
from omniperception.learning import CheckpointError

ARGUMENTS = {"run": "latest", "out": "", "formats": ",".join(FORMATS)}


def parse(arguments: Sequence[str]) -> Export:
    """From the command line."""
    own, overrides = config.split_arguments(arguments, ARGUMENTS)
    if overrides:
        raise config.ConfigError(f"{overrides[0]}: a policy is exported as it was trained; leave overrides out")
    out = Path(own["out"]) if own["out"] else None
    return Export(config.find_run(own["run"]), out, tuple(own["formats"].split(",")))


def summary(request: Export, described: Description) -> str:
    """What was written."""
    inputs = ", ".join(f"{name} {list(shape)}" for name, shape in described.inputs.items())
    lines = [
        f"{described.provenance['checkpoint']}: {inputs} -> {len(described.joints.names)} actions",
        f"control {1 / described.control_period_s:g} Hz"
        + (f", LiDAR {1 / described.lidar.period_s:g} Hz" if described.lidar else ", blind"),
    ]
    written = [*described.files.values(), "policy.json"]
    return "\n".join([*lines, f"wrote {', '.join(str(request.folder / name) for name in written)}"])


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError, ExportUnavailable):
        request = parse(sys.argv[1:])
        print(summary(request, export(request)))


if __name__ == "__main__":
    main()
