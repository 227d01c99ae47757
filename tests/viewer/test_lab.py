"""The scan lab: people who walk, noise and motion under knobs, what it refuses, and its page in a real browser."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
import torch
from browser import chromium, control, open_tab, picture, wait_for

from omnilidar import LidarFrame
from omniperception import build, config
from omniperception.commands.scan import NO_TASK
from omniperception.commands.scan.room import ROOM, DemoClass, demo_scene
from omniperception.viewer import PageOptions
from omniperception.viewer.lab import DT, Bench, Knobs, Lab, Walkers

PORT = 18232


@pytest.fixture(scope="module")
def task():
    return build.assemble(config.compose([*NO_TASK, "lidar=mid360", "lidar.num_rays=4000"])).env


@pytest.fixture
def room(task):
    return demo_scene(task.robot, num_threads=1, walkers=2)


def test_people_walk_at_their_speed_and_stay_in_the_room():
    walkers = Walkers.within(((-3.0, 3.0), (-2.0, 2.0)), 5)
    before = walkers.pos.copy()
    walkers.advance(0.1)
    inside = (np.abs(walkers.pos) < (2.5, 1.5)).all(1)
    assert np.hypot(*(walkers.pos - before)[inside].T) == pytest.approx(0.1)
    for _ in range(500):
        walkers.advance(0.1)
        assert (np.abs(walkers.pos) <= (2.5, 1.5)).all()


def test_scans_come_at_their_rate_and_see_the_people_where_they_are(task, room):
    bench = Bench(room, task.lidar, Knobs.of(task.lidar))
    due = [bench.step() for _ in range(20)]
    assert [k for k, d in enumerate(due) if d] == [4, 9, 14, 19] and DT == 0.02  # 10 Hz
    frame = bench.frame
    people = frame.points_w[0, (frame.class_id[0] == DemoClass.PERSON) & frame.valid[0]].numpy()
    assert len(people) > 10
    middles = room.scene.body_pos[0, list(room.movers), :2].numpy()
    distance = np.linalg.norm(people[:, None, :2] - middles, axis=2).min(1)
    assert distance.max() < 0.5  # arms and feet, before and behind
    walls = frame.points_w[0, frame.class_id[0] == DemoClass.WALL].numpy()
    (left, right), (back, front), _ = ROOM
    assert walls[:, 0].min() > left - 1e-3 and walls[:, 0].max() < right + 1e-3
    assert walls[:, 1].min() > back - 1e-3 and walls[:, 1].max() < front + 1e-3


def test_noise_and_range_are_what_the_knobs_say(task, room):
    bench = Bench(room, task.lidar, Knobs.of(task.lidar))
    bench.knobs.gaussian, bench.knobs.max_range = 0.05, 2.0
    bench.build()
    for _ in range(bench.knobs.steps):
        bench.step()
    frame = bench.frame
    error = (frame.ranges - frame.true_ranges)[frame.valid & (frame.true_ranges < 1.7)]
    assert float(error.std()) == pytest.approx(0.05, rel=0.1)
    assert float(frame.true_ranges[frame.valid].max()) <= 2.0


def test_a_turning_robot_distorts_a_scan_unless_points_are_placed_at_their_own_time(task, room):
    bench = Bench(room, task.lidar, Knobs.of(task.lidar))
    bench.knobs.turn, bench.knobs.distortion = 2.0, True
    bench.build()
    assert bench.knobs.segments == 5
    for _ in range(2 * bench.knobs.steps):
        bench.step()
    frame, scene = bench.frame, room.scene
    wall = frame.valid[0] & (frame.class_id[0] == DemoClass.WALL) & (frame.time_s[0] < 0.02)
    carrier = room.bodies[task.robot.base]
    pos, quat = scene.body_pos[0, carrier].double(), scene.body_quat[0, carrier].double()
    sensor = torch.tensor(task.lidar.quat, dtype=torch.float64)
    at = torch.tensor(task.lidar.mount_pos, dtype=torch.float64)
    points = _turned(sensor, frame.points_s[0, wall].double()) + at
    as_if_now = (_turned(quat, points) + pos).numpy()
    off = np.linalg.norm(as_if_now - frame.points_w[0, wall].numpy(), axis=1)
    reach = np.linalg.norm(frame.points_w[0, wall, :2].numpy() - pos[:2].numpy(), axis=1)
    turned = 2.0 * (0.1 - frame.time_s[0, wall].numpy())  # rad, since the point was measured
    assert off == pytest.approx(2 * reach * np.sin(turned / 2), rel=0.02)


def _turned(quat, points):
    w, v = quat[0], quat[1:].expand_as(points)
    return points + 2 * torch.linalg.cross(v, torch.linalg.cross(v, points) + w * points)


@pytest.mark.slow
def test_the_page_turns_knobs_refuses_what_cannot_be_and_writes_scans(task, room, tmp_path):
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    lab = Lab(room, {"mid360": lambda: task.lidar}, tmp_path, PageOptions(port=PORT, stop_after_s=600))
    failures: list[BaseException] = []

    def operate() -> None:
        try:
            with chromium() as browser:
                page = open_tab(browser)
                page.goto(f"http://127.0.0.1:{PORT}")
                noise = control(page, "Gaussian (m)")
                noise.fill("0.1")
                noise.press("Enter")
                wait_for(lambda: math.isclose(lab.bench.knobs.gaussian, 0.1), "a knob is turned")
                picture(page, tmp_path / "lab.png")
                page.get_by_role("button", name="write this scan").click()
                wait_for(lambda: list(tmp_path.glob("*.ply")), "a scan is written")
                lab.ask(lambda: lab.set("min_range", 50.0))
                wait_for(lambda: lab.message.startswith("refused: lidar.max_range"), "what cannot be is one line")
                assert lab.bench.knobs.min_range == task.lidar.min_range
        except BaseException as failure:  # of the other thread: raised in this one
            failures.append(failure)
        finally:
            lab.stop()

    operator = threading.Thread(target=operate)
    operator.start()
    try:
        lab.run()
    finally:
        operator.join()
        lab.close()
    if failures:
        raise failures[0]
    (path,) = tmp_path.glob("mid360_*.ply")
    assert LidarFrame.load(path).num_rays == 4000
