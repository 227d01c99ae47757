"""What the commands say when the viewer cannot be had: one line, and exit code 2."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import imageio_ffmpeg
import pytest

from omniperception.commands import demo, main
from omniperception.viewer import viewer

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


@pytest.mark.integration
@pytest.mark.parametrize(("line", "stem"), [([], "demo"), (["viewer=video", "scenario=static"], "demo-static")])
def test_without_a_display_the_demo_is_a_film(capsys, monkeypatch, tmp_path, line, stem):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo, "has_display", lambda: False)
    main(["demo", "video_s=0.2", "video_size=320,180", *line])
    said = capsys.readouterr().out
    assert f"wrote {stem}.mp4 and {stem}.png" in said and ("no display" in said) == (not line)
    frames = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / f"{stem}.mp4"))[0]
    assert frames == 5 and (tmp_path / f"{stem}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("line", "scenario"), [([], "moving"), (["scenario=corridor"], "corridor")])
def test_with_a_display_the_demo_opens_the_browser(monkeypatch, line, scenario):
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    opened = []
    monkeypatch.setattr(demo, "has_display", lambda: True)
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(demo, "serve", lambda shown, options: opened.append((shown, options)))
    main(["demo", *line])
    ((shown, options),) = opened
    assert options.open_browser and options.is_local
    assert shown.run_dir.name == "avoider" and shown.overrides == (f"scenario={scenario}",)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (("play", RUN, "viewer=web", "trials=5"), "trials= would mean nothing: viewer=web counts and films nothing;"),
        (("play", RUN, "viewer=web", "num_envs=4"), "num_envs=4: this command sets num_envs=1 itself"),
        (("demo", "viewer=video", "num_envs=4"), "num_envs=4: this command sets num_envs=1 itself; leave it out"),
    ],
)
def test_what_would_be_ignored_is_refused(capsys, line, expected):
    assert expected in said(capsys, *line)


def test_the_test_split_is_not_looked_at(capsys):
    message = said(capsys, "evaluate", RUN, "scenario=static", "split=test", "viewer=web")
    assert "viewer=web shows split=dev" in message
    message = said(capsys, "play", RUN, "viewer=web", "obstacles.split=test")
    assert "obstacles.split=test is for reports" in message and "no page may see it" in message


def test_a_missing_library_names_the_extra(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(viewer, "Session", lambda shown: pytest.fail("the task was built first"))
    message = said(capsys, "play", RUN, "viewer=web")
    assert "pip install 'omniperception[viewer]'" in message
