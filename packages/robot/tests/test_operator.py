"""Where commands come from."""

import os
import pty
import socket

import numpy as np
import pytest

from omnirobot.drive.machine import Request
from omnirobot.drive.operator import make_operator
from omnirobot.runtime import DeployError
from omnirobot.wire.messages import Remote

RANGES = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_z": [-1.5, 1.5]}
CENTRED = Remote(frozenset(), 0.0, 0.0, 0.0, 0.0)
START = np.zeros(3)


def test_sticks_reach_the_ends_of_the_trained_ranges():
    """Left stick up is ahead, left is left; right stick left turns left."""
    sticks = make_operator("remote", RANGES)
    assert sticks.poll(0.0, Remote(frozenset(), -1.0, -0.5, 0.0, 1.0), START)[0].tolist() == [1.0, 0.4, 0.75]
    assert sticks.poll(0.0, Remote(frozenset(), 1.0, 1.0, 0.0, -0.5), START)[0].tolist() == [-0.25, -0.4, -1.5]
    assert sticks.poll(0.0, Remote(frozenset(), 0.04, -0.04, 0.0, 0.04), START)[0].tolist() == [0.0, 0.0, 0.0]


def test_back_is_never_ahead_where_training_left_zero_out():
    """Nor does a goal behind the robot lead ahead."""
    ranges = {"lin_vel_x": [0.3, 1.0], "lin_vel_y": [-0.4, -0.1], "ang_vel_z": [-1.5, 1.5]}
    sticks = make_operator("remote", ranges)
    assert sticks.poll(0.0, Remote(frozenset(), -1.0, 0.0, 0.0, -1.0), START)[0].tolist() == [0.0, 0.0, 0.0]
    assert sticks.poll(0.0, Remote(frozenset(), 1.0, 0.0, 0.0, 1.0), START)[0].tolist() == [1.0, -0.4, 0.0]
    command, _ = make_operator("goal:-5,0", ranges).poll(0.0, CENTRED, START)
    assert np.abs(command[:2]).max() < 1e-9 and abs(command[2]) == 1.5


def test_datagrams_hold_for_half_a_second():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    operator = make_operator(f"udp:{port}", RANGES)
    with pytest.raises(DeployError, match=f"steer=udp:{port}: the port cannot be listened to"):
        make_operator(f"udp:{port}", RANGES)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        for text in ("stand", "0.5 0.1 -0.2", "nan 0 0", "1 2", "hop", "walk", "stop"):
            other.sendto(text.encode(), ("127.0.0.1", port))
    command, asked = operator.poll(10.0, CENTRED, START)
    assert command.tolist() == [0.5, 0.1, -0.2] and asked == [Request.STAND, Request.WALK, Request.STOP]
    assert operator.poll(10.4, CENTRED, START)[0].tolist() == [0.5, 0.1, -0.2]
    assert operator.poll(10.6, CENTRED, START) == (pytest.approx(np.zeros(3)), [])
    operator.close()


def test_arrows_are_no_e_stop(monkeypatch):
    """An arrow begins as the Escape key does."""
    terminal, typed = pty.openpty()
    with open(typed, closefd=False) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        keyboard = make_operator("keyboard", RANGES)
        for keys, share, asked in ((b"w", 0.2, []), (b"\x1b[A\x1bOBw", 0.4, []), (b"\x1b", 0.4, [Request.STOP])):
            os.write(terminal, keys)
            command, got = keyboard.poll(0.0, CENTRED, START)
            assert command[0] == pytest.approx(share) and got == asked
        keyboard.close()
    os.close(terminal), os.close(typed)


@pytest.mark.parametrize("is_an_error", [False, True])
def test_a_robot_whose_terminal_is_gone_stops_and_lies_down(monkeypatch, is_an_error):
    """As by a connection that drops: asked for once, so that the remote may ask for something else."""
    terminal, typed = pty.openpty()
    with open(typed, closefd=False) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        keyboard = make_operator("keyboard", RANGES)
        os.write(terminal, b"wwq")
        assert keyboard.poll(0.0, CENTRED, START)[0].tolist() == pytest.approx([0.4, 0.0, 0.3])
        os.close(terminal)
        if is_an_error:
            monkeypatch.setattr("os.read", lambda *_: os.close(-1))
        command, asked = keyboard.poll(0.02, CENTRED, START)
        assert command.tolist() == [0.0, 0.0, 0.0] and asked == [Request.LIE]
        command, asked = keyboard.poll(0.04, CENTRED, START)
        assert command.tolist() == [0.0, 0.0, 0.0] and asked == []
        keyboard.close()
    os.close(typed)


def test_one_command_for_good_and_wrong_words():
    assert make_operator("0.5,0,-0.1", RANGES).poll(0.0, CENTRED, START)[0].tolist() == [0.5, 0.0, -0.1]
    expected = r"remote, keyboard, udp:PORT, goal:X,Y\[,SPEED\] or V_X,V_Y,YAW_RATE"
    for text in (
        "joystick",
        "1,2",
        "udp:x",
        "goal:1",
        "goal:1,x",
        "goal:1,2,-1",
        "nan,0,0",
        "udp:0",
        "udp:²",
        "udp:99999",
    ):
        expected = "the port cannot be listened to" if text == "udp:99999" else expected
        with pytest.raises(DeployError, match=f"steer={text}: {expected}"):
            make_operator(text, RANGES)


def test_a_goal_is_faced_and_stayed_at():
    """Five metres to the left: half the speed aside, within the trained ranges; 0.5 m away half of that."""
    goal = make_operator("goal:0,5,0.3", RANGES)
    command, asked = goal.poll(0.0, CENTRED, START)
    assert command == pytest.approx([0.0, 0.3, 1.5]) and not asked
    assert goal.poll(0.0, CENTRED, np.array([0.0, 4.5, np.pi / 2]))[0] == pytest.approx([0.15, 0.0, 0.0])
    assert goal.poll(0.0, CENTRED, np.array([0.1, 5.1, 2.0]))[0].tolist() == [0.0, 0.0, 0.0]
    assert make_operator("goal:5,0", RANGES).poll(0.0, CENTRED, START)[0] == pytest.approx([0.5, 0.0, 0.0])
    behind = make_operator("goal:-5,0,2.0", RANGES).poll(0.0, CENTRED, np.array([0.0, 0.0, 0.0]))[0]
    assert behind[0] == -0.5 and abs(behind[2]) == 1.5
