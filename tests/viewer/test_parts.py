"""Parts of the viewer that need no page: pacing, the stick, geometry, drawings, addresses."""

from __future__ import annotations

import math
import os
import queue
import socket

import numpy as np
import pytest

from omnilidar import Shape, ShapeKind
from omniperception import config
from omniperception.viewer import PageOptions, ViewerError
from omniperception.viewer.clock import BEHIND_S, Clock
from omniperception.viewer.drive import Stick
from omniperception.viewer.meshes import grid_surface, triangles
from omniperception.viewer.panels import _runs
from omniperception.viewer.stage import on_level, sector_lines, turned
from omniperception.viewer.viewer import Viewer


class Time:
    """A clock that a test moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize("speed, wall_s", [(1.0, 1.0), (0.25, 4.0), (2.0, 0.5)])
def test_fast_steps_are_paced_to_the_speed_that_is_asked_for(speed, wall_s):
    time = Time()
    clock = Clock(0.02, 25.0, time)
    clock.speed = speed
    for _ in range(50):
        time.now += 0.003
        time.now += clock.stepped()
    assert time.now - 100.0 == pytest.approx(wall_s, abs=0.01)


def test_slow_steps_are_not_caught_up_with_and_pictures_are_dropped():
    time = Time()
    clock = Clock(0.02, 25.0, time)
    drawn = 0
    for _ in range(100):
        time.now += 0.04  # twice as long as real time allows
        assert clock.stepped() == 0.0
        drawn += clock.picture_is_due()
    assert clock.reached == pytest.approx(0.5, rel=0.05)
    assert 4.0 * 4 <= drawn <= 4.0 * 4 + 4  # LEAST_HZ over the 4 s, and those before the steps were late
    assert clock.dropped > 50
    time.now += 0.0
    clock.start()
    assert 0.0 < clock.stepped() <= 0.02 < BEHIND_S


def test_a_stick_stays_within_its_bounds():
    stick = Stick()
    for _ in range(20):
        stick.moved(ahead=0.2, turn=-0.25)
    assert stick.value == (1.5, 0.0, -1.5)
    assert stick.moved(ahead=-0.2) == (1.3, 0.0, -1.5)


def test_a_mouse_on_a_level_by_hand():
    eye = np.array([0.0, 0.0, 2.0])
    assert on_level(eye, np.array([1.0, 0.5, -1.0]), 0.5, np.zeros(3)) == pytest.approx((1.5, 0.75))
    level = np.array([4.0, 5.0, 2.0])
    assert on_level(eye, np.array([1.0, 0.0, 0.0]), 0.5, level) == (4.0, 5.0)  # looks at the horizon
    assert turned(np.array([1.0, 0.0]), math.pi / 2) == pytest.approx((0.0, 1.0))


def test_sectors_lie_where_their_obstacles_are():
    sectors = np.zeros((36, 3), np.float32)
    sectors[:, 0] = np.inf
    sectors[18] = (2.0, 0.0, 1.0)  # the first sector to the left of straight ahead, moving to the left
    lines = sector_lines(sectors, np.array([1.0, 1.0]), math.pi / 2, 0.1)
    *arc, motion = lines
    for point in np.concatenate(arc):
        assert np.hypot(*(point[:2] - 1.0)) == pytest.approx(2.0, abs=1e-5)
        bearing = math.degrees(math.atan2(point[1] - 1.0, point[0] - 1.0)) - 90.0
        assert 0.0 < bearing < 10.0
    assert motion[1, :2] - motion[0, :2] == pytest.approx((-0.5, 0.0), abs=1e-5)  # half a second, turned by the yaw
    assert lines[..., 2] == pytest.approx(0.1)
    assert len(sector_lines(np.full((36, 3), np.inf), np.zeros(2), 0.0, 0.0)) == 0


@pytest.mark.parametrize(
    "kind, size, volume",
    [
        (ShapeKind.BOX, (0.1, 0.2, 0.3), 8 * 0.1 * 0.2 * 0.3),
        (ShapeKind.SPHERE, (0.3,), 4 / 3 * math.pi * 0.3**3),
        (ShapeKind.CYLINDER, (0.2, 0.5), math.pi * 0.2**2 * 1.0),
        (ShapeKind.CAPSULE, (0.2, 0.5), math.pi * 0.2**2 * 1.0 + 4 / 3 * math.pi * 0.2**3),
        (ShapeKind.ELLIPSOID, (0.1, 0.2, 0.3), 4 / 3 * math.pi * 0.1 * 0.2 * 0.3),
    ],
)
def test_triangles_hold_the_volume_of_their_shape_around_its_middle(kind, size, volume):
    mesh = triangles(Shape(kind, size))
    assert mesh.volume == pytest.approx(volume, rel=0.06)
    assert mesh.volume <= volume * 1.0001
    assert mesh.bounds.mean(0) == pytest.approx((0, 0, 0), abs=1e-9)


def test_a_surface_over_a_grid_looks_up():
    mesh = grid_surface(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]), np.array([[0, 1, 2], [0, 1, 2]]))
    assert mesh.area == pytest.approx(2 * math.sqrt(2))
    assert (mesh.face_normals[:, 2] > 0).all()


def test_runs_to_choose_from_are_the_newest_first_and_the_shipped_ones_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for k, name in enumerate(("old", "new")):
        run = tmp_path / "outputs" / name
        run.mkdir(parents=True)
        (run / config.CONFIG_FILE).touch()
        os.utime(run / config.CONFIG_FILE, (k, k))
    shipped = config.SHIPPED_RUNS / "avoider"
    found = _runs(shipped)
    assert found[:3] == [str(shipped), "outputs/new", "outputs/old"] and found.count(str(shipped)) == 1
    assert str(config.SHIPPED_RUNS / "gait") in found


def test_options_say_what_is_wrong():
    with pytest.raises(ViewerError, match=r"^port=70000 must lie in 1 to 65535$"):
        PageOptions(port=70000)
    assert PageOptions().is_local and not PageOptions(host="0.0.0.0").is_local


def test_the_page_says_who_can_reach_it_and_refuses_a_taken_port():
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    from omniperception.viewer.page import announcement, open_page

    assert "this machine alone" in announcement(PageOptions())
    assert "WHOEVER REACHES THIS MACHINE" in announcement(PageOptions(host="0.0.0.0"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ViewerError) as raised:
            open_page(PageOptions(port=port), "taken")
    message = str(raised.value)
    assert message.startswith(f"the viewer cannot listen on 127.0.0.1:{port} (address already in use)")
    assert f"port={port + 1}" in message and "\n" not in message


@pytest.mark.parametrize("host", ["192.0.2.1", "999.1.1.1"])  # of no machine, and no address
def test_an_address_that_is_not_here_is_told_from_a_port(host):
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    from omniperception.viewer.page import open_page

    with pytest.raises(ViewerError, match=r"give another, such as host=127\.0\.0\.1$"):
        open_page(PageOptions(host, 18299), "none")


class Held:
    """A session that notes which obstacles are held and taken away."""

    def __init__(self):
        self.done = []

    def obstacle_of(self, part):
        return part

    def hold(self, obstacle, xy):
        self.done.append(("hold", obstacle))

    def take_away(self, obstacle):
        self.done.append(("take away", obstacle))


@pytest.mark.parametrize("rebuilt", [False, True])
def test_an_obstacle_of_a_task_that_is_gone_is_not_another_one_now(rebuilt):
    viewer = Viewer.__new__(Viewer)
    viewer._requests, viewer.session = queue.Queue(), Held()
    viewer._obstacle_dragged(3, "begin", (0.0, 0.0))
    viewer._obstacle_taken(3)
    if rebuilt:
        viewer.session = Held()
    viewer.serve_requests()
    assert viewer.session.done == ([] if rebuilt else [("hold", 3), ("take away", 3)])
