"""The commands of `omnirobot`, a module each."""

from omnirobot.common.cli import Program

COMMANDS = {
    "drive": "runs an exported policy on a Go2, or on a simulated one",
    "replay": "runs an exported policy on a recording or a ROS 2 bag, open loop, and draws it",
}
EXTRAS = {
    "matplotlib": "plots",
    **dict.fromkeys(("mcap", "rosbags"), "recordings"),
}
"""Extra of this package that brings each library."""

main = Program("omnirobot", COMMANDS, {name: f"omnirobot.commands.{name}" for name in COMMANDS}, EXTRAS)
