"""Where commands come from."""

import socket

import numpy as np
import pytest

from omniperception.deploy import DeployError
from omniperception.hardware.machine import Request
from omniperception.hardware.messages import Remote
from omniperception.hardware.operator import make_operator

RANGES = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_z": [-1.5, 1.5]}
CENTRED = Remote(frozenset(), 0.0, 0.0, 0.0, 0.0)


def test_sticks_reach_the_ends_of_the_trained_ranges():
    """Left stick up is ahead, left is left; right stick left turns left."""
    sticks = make_operator("remote", RANGES)
    assert sticks.poll(0.0, Remote(frozenset(), -1.0, -0.5, 0.0, 1.0))[0].tolist() == [1.0, 0.4, 0.75]
    assert sticks.poll(0.0, Remote(frozenset(), 1.0, 1.0, 0.0, -0.5))[0].tolist() == [-0.25, -0.4, -1.5]
    assert sticks.poll(0.0, Remote(frozenset(), 0.04, -0.04, 0.0, 0.04))[0].tolist() == [0.0, 0.0, 0.0]


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
    command, asked = operator.poll(10.0, CENTRED)
    assert command.tolist() == [0.5, 0.1, -0.2] and asked == [Request.STAND, Request.WALK, Request.STOP]
    assert operator.poll(10.4, CENTRED)[0].tolist() == [0.5, 0.1, -0.2]
    assert operator.poll(10.6, CENTRED) == (pytest.approx(np.zeros(3)), [])
    operator.close()


def test_one_command_for_good_and_wrong_words():
    assert make_operator("0.5,0,-0.1", RANGES).poll(0.0, CENTRED)[0].tolist() == [0.5, 0.0, -0.1]
    for text in ("joystick", "1,2", "udp:x"):
        with pytest.raises(DeployError, match=f"steer={text}: remote, keyboard, udp:PORT or V_X,V_Y,YAW_RATE"):
            make_operator(text, RANGES)
