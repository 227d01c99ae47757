"""The guide's way from a URDF to a policy: its commands run, shortened, for a robot of two legs and one of six."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

from omniperception.commands import main
from omniperception.learning import latest_checkpoint

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "guide" / "from_urdf.md"
SHORTER = {
    "train": (
        *("num_envs=4", "ppo.max_iterations=2", "ppo.num_steps_per_env=4", "ppo.num_mini_batches=1"),
        *("ppo.num_learning_epochs=1", "ppo.hidden_dims=[16]"),
    ),
    "play": ("trials=2", "video_s=0.2", "terminations.episode_length_s=0.3"),
    "evaluate": ("trials=2", "plots=false", "terminations.episode_length_s=0.3"),
}
"""Overrides of each command that take the place of the page's, if it has them."""
FEET = {"strider": 2, "spider": 6}


def commands():
    """The command lines of the page, as lists of words."""
    blocks = re.findall(r"```\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return [shlex.split(line)[1:] for block in blocks for line in block.splitlines()]


def shortened(words):
    """A command line with its overrides of SHORTER."""
    own = SHORTER.get(words[0], ())
    keys = {override.partition("=")[0] for override in own}
    return [*(word for word in words if word.partition("=")[0] not in keys), *own]


@pytest.mark.parametrize("robot", FEET)
def test_the_commands_lead_from_a_urdf_to_a_policy(robot, tmp_path, monkeypatch, capsys):
    pytest.importorskip("onnxruntime", reason="extra deploy")
    pytest.importorskip("onnx", reason="extra export")
    monkeypatch.chdir(tmp_path)
    shutil.copy(HERE / "data" / f"{robot}.urdf", "mine.urdf")
    ran = []
    for words in commands():
        main(shortened(words))
        ran.append(words[0])
    said = capsys.readouterr().out
    assert ran == ["robot-new", "robot-check", "train", "play", "train", "play", "evaluate", "export"]
    assert said.count("after 2 s it stands") == 2 and "NOT A FOOT ON THE GROUND" not in said
    preset = yaml.safe_load(Path("conf/robot/mine.yaml").read_text())
    assert len(preset["foot_geoms"]) == FEET[robot] and preset["mounts"]["head"]["body"] == "lidar"
    for run in ("short", "gait"):
        assert latest_checkpoint(Path("outputs", run)).name == "model_2.pt"
        assert json.loads(Path("outputs", run, "replay.json").read_text())["num_envs"] == 2
    policy = json.loads(Path("outputs/gait/exported/policy.json").read_text())
    assert policy["joints"]["names"] == preset["joints"] and policy["stepping"]["offsets"]
