"""The commands of `omniperception`, a module each."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from omniperception.cli import terminal

COMMANDS = {
    "demo": "shows the published policy among moving obstacles, in the browser or as a film",
    "train": "trains a policy, or goes on with a run",
    "runs": "lists runs: recipe, iterations, newest rates",
    "curves": "draws learning curves of runs, mean and spread over seeds",
    "play": "replays a run: rates over whole episodes, and a video",
    "evaluate": "evaluates runs in fixed worlds, beside baselines",
    "gait": "looks at a gait: where it breaks, which kicks it survives, when its feet are down",
    "tables": "renders the results tables of the docs from files of results",
    "ablate": "trains and evaluates variants of the perception over seeds",
    "export": "exports a policy for a robot or another simulator",
    "robot": "runs an exported policy on a Go2, or on a simulated one",
    "robot-sim": "simulates a Go2 and its LiDAR on the robot's own wire",
    "robot-trials": "tries a policy over the wire in real time, with and without faults; tables",
    "replay-bag": "runs an exported policy on a recording or a ROS 2 bag, open loop, and draws it",
    "publish": "makes a small run directory, fit for a repository",
    "scan": "draws what a LiDAR sees",
    "robot-new": "writes a preset for a robot from its MJCF or URDF, and says what it guessed",
    "robot-check": "stands a robot: contacts, joints and their reach, what its LiDAR sees of it, a picture",
    "robot-fetch": "downloads robots that presets name and this package does not ship: Go1, G1",
    "plan": "lists what a configuration consists of and what was left out",
}
EXTRAS = {
    "PIL": "train",
    "hydra": "train",
    "imageio_ffmpeg": "train",
    "mujoco": "train",
    "omegaconf": "train",
    "rsl_rl": "train",
    "tensorboard": "train",
    "tensordict": "train",
    "yaml": "train",
    "matplotlib": "plots",
    "onnx": "export",
    "onnxruntime": "deploy",
    "cyclonedds": "robot",
    **dict.fromkeys(("collada", "trimesh"), "meshes"),
    "viser": "viewer",
    **{name: name for name in ("mlflow", "trackio", "wandb")},
    **dict.fromkeys(("laspy", "mcap", "mcap_ros2", "pypcd4", "rosbags"), "clouds"),
}
"""Extra of this package that brings each library."""


def main(argv: Sequence[str] | None = None) -> None:
    """Runs `omniperception <command> [key=value ...]`."""
    with terminal():
        _run(list(sys.argv[1:] if argv is None else argv))


def _run(argv: list[str]) -> None:
    name, *rest = argv or ["--help"]
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = (f"  {command:<{width}}  {what}" for command, what in COMMANDS.items())
        print("\n".join(["usage: omniperception <command> [key=value ...]", "", *lines, ""]))
        print("omniperception <command> --help explains a command.")
        return
    if name not in COMMANDS:
        _fail(f"{name} is unknown; known: {', '.join(COMMANDS)}")
    try:
        command = importlib.import_module(f"omniperception.commands.{name.replace('-', '_')}").command
        command(rest, f"omniperception {name}")
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in EXTRAS:
            raise
        _fail(f"{name} needs {library}: pip install 'omniperception[{EXTRAS[library]}]'")


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
