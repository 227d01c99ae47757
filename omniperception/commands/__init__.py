"""The commands of `omniperception`, a module each."""

from omnirobot.common.cli import Program

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
_TRAIN = "PIL hydra imageio_ffmpeg mujoco omegaconf pydantic rsl_rl tensorboard tensordict yaml"
EXTRAS = {
    **dict.fromkeys(_TRAIN.split(), "train"),
    "matplotlib": "plots",
    "onnx": "export",
    **dict.fromkeys(("collada", "trimesh"), "meshes"),
    "viser": "viewer",
    **{name: name for name in ("mlflow", "trackio", "wandb")},
    **dict.fromkeys(("laspy", "mcap", "mcap_ros2", "pypcd4", "rosbags"), "clouds"),
}
"""Extra of this package that brings each library."""
_OF_ROBOT = {"robot": "omnirobot.commands.drive", "replay-bag": "omnirobot.commands.replay"}

main = Program(
    "omniperception",
    COMMANDS,
    {name: _OF_ROBOT.get(name, f"omniperception.commands.{name.replace('-', '_')}") for name in COMMANDS},
    EXTRAS,
)
