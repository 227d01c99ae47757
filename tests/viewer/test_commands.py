"""What the commands say when the viewer cannot be had: one line, and exit code 2."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from omniperception.commands import main

RUN = f"run={Path(__file__).parents[2] / 'pretrained' / 'avoider'}"


@pytest.fixture
def taken():
    """A port that somebody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def said(capsys, *line):
    """The one line on standard error."""
    with pytest.raises(SystemExit) as raised:
        main(list(line))
    assert raised.value.code == 2
    (message,) = capsys.readouterr().err.splitlines()
    return message


@pytest.mark.parametrize("line", [("play", RUN), ("evaluate", RUN, "scenario=static"), ("scan", "lidar=mid360")])
def test_a_taken_port(capsys, taken, line):
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    message = said(capsys, *line, "viewer=web", f"port={taken}")
    assert f"cannot listen on 127.0.0.1:{taken}" in message and f"port={taken + 1}" in message


def test_the_test_split_is_not_looked_at(capsys):
    message = said(capsys, "evaluate", RUN, "scenario=static", "split=test", "viewer=web")
    assert "viewer=web shows split=dev" in message


def test_a_missing_library_names_the_extra(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    message = said(capsys, "play", RUN, "viewer=web")
    assert "pip install 'omniperception[viewer]'" in message
