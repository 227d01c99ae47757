"""Videos: what is where geometry says, a camera that sees the robot, and files that play."""

import math

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from omnilidar import Shape, ShapeKind
from omniperception.avoidance.sector_motion import NEARNESS_RANGE
from omniperception.evaluation.film.camera import CAMERAS, FollowCamera
from omniperception.evaluation.film.overlay import sector_plot
from omniperception.evaluation.film.render import Arrow, Renderer, View
from omniperception.evaluation.film.video import Recorder
from omniperception.evaluation.film.video_options import VideoOptions
from omniperception.scene.rays import HitClass, RayShapes
from omnirobot.common.errors import ConfigError

WIDTH, HEIGHT = 64, 36
BALL = Shape(ShapeKind.SPHERE, (0.5,), body=0, class_id=HitClass.ROBOT)
GROUND = Shape(ShapeKind.PLANE, class_id=HitClass.TERRAIN)
BALL_ON_GROUND = RayShapes((GROUND, BALL), ("ground", "ball"), (1,), base=0)
NO_POINTS = torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool)


def view(ball_pos=(0.0, 0.0, 1.0), points=NO_POINTS, arrows=()):
    """A level camera 4 m before the origin at 1 m height, looking along +x."""
    ball_pos, identity = torch.tensor([ball_pos]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    return View(torch.tensor([-4.0, 0, 1]), torch.tensor([0.0, 0, 1]), ball_pos, identity, *points, arrows)


@pytest.fixture(scope="module")
def renderer():
    return Renderer(BALL_ON_GROUND, WIDTH, HEIGHT, fov_deg=60.0)


def is_dark(pixel):
    return int(pixel.max()) < 150


def blueness(pixel):
    return int(pixel[2]) - int(pixel[0])


def test_sky_above_ground_below_ball_in_the_middle(renderer):
    image = renderer.render(view()).int()
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert is_dark(image[18, 32]) and not is_dark(image[18, 2])
    left = renderer.render(view(ball_pos=(0.0, 1.0, 1.0)))  # +y is left of a camera that looks along +x
    assert is_dark(left[18, 24]) and not is_dark(left[18, 40])
    assert blueness(image[1, 2]) > 20  # the sky
    assert abs(blueness(image[34, 2])) < 20  # the ground is grey


def test_a_ball_covers_its_angular_size(renderer):
    # radius 0.5 m at 4 m: tan(asin(1/8)) = 0.126; focal length 18 / tan 30 deg = 31.2 pixels: 3.93 each side
    image = renderer.render(view())
    dark = image[18].amax(1) < 150
    assert abs(int(dark.sum()) - 2 * 18 / math.tan(math.radians(30)) * math.tan(math.asin(0.5 / 4))) <= 1.0


@pytest.fixture(scope="module")
def fine_renderer():
    """Ten times as many pixels each way: a focal length of 312."""
    return Renderer(BALL_ON_GROUND, 10 * WIDTH, 10 * HEIGHT, fov_deg=60.0)


def test_points_hide_behind_things_and_have_two_colours(fine_renderer):
    points = torch.tensor([[-1.0, 0.0, 1.0], [2.0, 0.5, 1.0], [-1.0, 1.5, 1.0]])
    with_points = fine_renderer.render(view(points=(points, torch.tensor([True, True, False])))).int()
    change = with_points - fine_renderer.render(view()).int()
    assert blueness(change[180, 320]) < -50  # the proximal point 3 m ahead, before the ball
    assert blueness(change[180, 320 - 156]) > 30  # 312 * 1.5 / 3 to the left, a distal one
    assert not change[170:190, 285:305].any()  # 312 * 0.5 / 6 to the left, behind the ball


def test_an_arrow_lies_on_the_ground_where_it_points(renderer):
    arrow = Arrow(torch.tensor([-2.0, 0.0]), torch.tensor([1.5, 0.0]), 0.4, (0.0, 1.0, 0.0))
    with_arrow = renderer.render(view(ball_pos=(0.0, 0.0, -50.0), arrows=(arrow,))).int()
    # its middle (-1.25, 0, 0) is 2.75 m ahead of the camera and 1 m below: row 18 + 31.2 / 2.75 = 29.3
    greenness = with_arrow[29, :, 1] - with_arrow[29, :, 0]
    assert greenness[32] > 50 and abs(greenness[60]) < 20


def test_something_in_the_sun_throws_a_shadow(renderer):
    # the sun is at (-0.42, 0.46, 0.78): the shadow of a ball 2 m up falls around (1.08, -1.18, 0)
    shadow_row, shadow_column = 18 + 31.2 / 5.08, 32 + 31.2 * 1.18 / 5.08
    at = round(shadow_row), round(shadow_column)
    lit = renderer.render(view(ball_pos=(0.0, 0.0, -50.0))).int()[at]
    dark = renderer.render(view(ball_pos=(0.0, 0.0, 2.0))).int()[at]
    assert int(lit.max()) - int(dark.max()) > 40


def way_is_free(eye, robot, boxes):
    """Whether a segment meets no box, by the slab method; boxes are (centre, half sizes)."""
    for centre, half in boxes:
        with np.errstate(divide="ignore"):
            slabs = (np.stack((np.subtract(centre, half), np.add(centre, half))) - eye) / (robot - eye)
        if max(slabs.min(0).max(), 0.0) < min(slabs.max(0).min(), 1.0):
            return False
    return True


def angle_deg(a, b):
    return math.degrees(math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0)))


CORRIDOR = (
    ((3.0, 0.8, 1.0), (7.0, 0.1, 1.0)),
    ((3.0, -0.8, 1.0), (7.0, 0.1, 1.0)),
    ((-4.0, 0.0, 1.0), (0.1, 0.9, 1.0)),
)
"""A corridor of 1.4 m along +x, closed behind; centres and half sizes (m) of its walls."""


@pytest.mark.parametrize("kind", CAMERAS)
def test_in_a_corridor_the_robot_is_in_the_picture_and_nothing_before_it(kind):
    walls = [Shape(ShapeKind.BOX, half, pos=pos, class_id=HitClass.OBSTACLE) for pos, half in CORRIDOR]
    names = ("ground", *"abc", "ball")
    shapes = RayShapes((GROUND, *walls, BALL), names, (1,), base=0)
    renderer = Renderer(shapes, WIDTH, HEIGHT)
    camera = FollowCamera(0.04, kind)
    for step in range(220):
        x, yaw = min(0.04 * step, 6.0) - 3.0, max(step - 150, 0) * 0.1  # walks 6 m, then turns twice around
        foot = torch.tensor([x, 0.3 * math.sin(x), 0.0])
        renderer.place(foot + torch.tensor([[0.0, 0.0, 0.3]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), None)
        eye, target = camera.follow(foot, torch.tensor(yaw), renderer.free_share)
        eye, ahead = eye.double().numpy(), (target - eye).double().numpy()
        robot = foot.double().numpy() + np.array([0, 0, 0.3])
        assert eye[2] > 0 and way_is_free(eye, robot, CORRIDOR)
        assert angle_deg(ahead, robot - eye) < 46.0 / 2 and np.linalg.norm(robot - eye) > 0.5


def test_among_pillars_the_camera_moves_smoothly():
    angles = [(k + 0.5) * math.pi / 5 for k in range(10)]
    at = [(r * math.cos(a + 0.1 * r), r * math.sin(a + 0.1 * r)) for a in angles for r in (2.4, 4.6, 6.2)]
    height, radius = 2.4, 0.25
    half = radius, height / 2
    pillars = [Shape(ShapeKind.CYLINDER, half, pos=(*xy, half[1]), class_id=HitClass.OBSTACLE) for xy in at]
    shapes = RayShapes((GROUND, *pillars, BALL), tuple(map(str, range(len(at) + 2))), (1,), base=0)
    renderer, camera, before = Renderer(shapes, WIDTH, HEIGHT), FollowCamera(0.04), None
    for step in range(400):  # 0.9 m/s along a circle of 3.5 m between them, looking about
        around = 0.04 * step * 0.9 / 3.5
        foot = torch.tensor([3.5 * math.cos(around), 3.5 * math.sin(around), 0.0])
        yaw = torch.tensor(around + math.pi / 2 + 0.8 * math.sin(0.05 * step))
        renderer.place(foot[None], torch.tensor([[1.0, 0.0, 0.0, 0.0]]), None)
        offset = (camera.follow(foot, yaw, renderer.free_share)[0] - foot).double().numpy()
        way = foot.double().numpy() + np.linspace([0.0, 0.0, 0.3], offset, 60)
        inside = np.linalg.norm(way[:, None, :2] - np.array(at), axis=2) < radius
        assert not (inside.any(1) & (way[:, 2] < height)).any()
        assert before is None or np.linalg.norm(offset - before) < 0.5  # m from one picture to the next
        before = offset


@pytest.mark.parametrize("kind", ["chase", "side"])
def test_a_low_wall_does_not_hide_the_legs(kind):
    # the camera's place is beyond the wall, whose top is 0.3 m high
    walls = (((0.0, -0.3, 0.15), (9.0, 0.02, 0.15)),)
    shapes = RayShapes(
        (GROUND, Shape(ShapeKind.BOX, walls[0][1], pos=walls[0][0], class_id=HitClass.OBSTACLE), BALL),
        ("ground", "wall", "ball"),
        (1,),
        base=0,
    )
    renderer, camera = Renderer(shapes, WIDTH, HEIGHT), FollowCamera(0.04, kind)
    yaw = math.radians({"chase": 90.0, "side": 0.0}[kind])
    eye, _ = camera.follow(torch.zeros(3), torch.tensor(yaw), renderer.free_share)
    eye = eye.double().numpy()
    assert eye[1] < -0.3 and way_is_free(eye, np.array([0.0, 0.0, 0.1]), walls)


@pytest.mark.parametrize(("kind", "yaw", "way"), [("chase", 90, (0, -1)), ("side", 90, (1, 0)), ("top", 90, (-1, 0))])
def test_in_the_open_each_camera_is_where_it_belongs(kind, yaw, way):
    camera, place = FollowCamera(0.04, kind), CAMERAS[kind]
    foot = torch.tensor([5.0, -2.0, 0.1])
    eye, _ = camera.follow(foot, torch.tensor(math.radians(yaw)), lambda start, ends: torch.ones(len(ends)))
    offset = (eye - foot).double().numpy() - np.array([0, 0, 0.3])
    assert np.linalg.norm(offset) == pytest.approx(place.distance, abs=1e-5)
    assert math.degrees(math.asin(offset[2] / place.distance)) == pytest.approx(place.elevation_deg, abs=1e-3)
    assert offset[:2] / np.linalg.norm(offset[:2]) == pytest.approx(way, abs=1e-4)


def test_the_inset_has_obstacles_where_they_are():
    # from behind counter-clockwise: behind right, ahead right, ahead left, behind left
    perceived, true = np.full((2, 4, 3), np.inf)
    perceived[2], true[1] = (2.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    changed = np.asarray(sector_plot(perceived, true, 200)) != np.asarray(sector_plot(None, None, 200))
    up, right = 100 - np.argwhere(changed.any(2)).T[0], np.argwhere(changed.any(2)).T[1] - 100
    metres = np.hypot(up, right) * NEARNESS_RANGE / 98  # the rim is at 98 pixels
    assert up.min() >= -1
    ahead_left, ahead_right = metres[right < -1], metres[right > 1]
    assert ahead_left.min() == pytest.approx(2.0, abs=0.1) and np.ptp(ahead_left) == pytest.approx(0.4, abs=0.1)
    assert ahead_right.mean() == pytest.approx(1.0, abs=0.05) and np.ptp(ahead_right) < 0.3


def test_a_grid_of_environments_plays(make_env, tmp_path):
    env = make_env("obstacles=static", "num_envs=4")
    options = VideoOptions((2 * WIDTH, 2 * HEIGHT), (3, 0, 2))
    recorder = Recorder(env, tmp_path / "a.mp4", 0.12, options)
    for _ in range(10):
        env.step(torch.zeros(4, 12))
        recorder()
    recorder.close()
    assert recorder.frames_left == 0
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert frames == 3 and seconds == pytest.approx(0.12, abs=0.01)
    recorder.write_still(tmp_path / "a.png")
    pixels = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    assert pixels.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    panels = [pixels[r : r + HEIGHT, c : c + WIDTH] for r in (0, HEIGHT) for c in (0, WIDTH)]
    assert all(np.ptp(panel) > 50 for panel in panels[:3]) and panels[3].max() == 0  # three, and none
    assert not np.array_equal(panels[0], panels[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"video_size": (63, 36)}, "video_size=63,36 must be width,height, two even numbers such as 1280,720"),
        ({"video_size": (64,)}, "video_size=64 must be width,height"),
        ({"video_envs": (1, 1)}, "video_envs=1,1 must be different numbers"),
        ({"video_size": (64, 36), "video_envs": tuple(range(16))}, "leaves 16 x 9 pixels for each"),
        ({"video_envs": (0, 4)}, "video_envs=0,4: there are 4 environments, from 0 on; num_envs=5 would do"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        VideoOptions(**options).check_fits(4)


def test_lidar_points_lie_on_what_was_hit(make_env, tmp_path):
    env = make_env("obstacles=static", "num_envs=2", "perception=proximity_gru")
    recorder = Recorder(env, tmp_path / "a.mp4", 1.0, VideoOptions((WIDTH, HEIGHT), (1,)))
    for _ in range(5):
        env.step(torch.zeros(2, 12))
    points = recorder._view(1).points_w
    hit = env.sensing.frame.class_id[1][env.sensing.frame.ranges[1].isfinite()]
    recorder.close()
    on_ground = points[hit == HitClass.TERRAIN]
    assert len(points) == len(hit) and len(on_ground) > 20
    assert on_ground[:, 2].abs().max() < 1e-3


def test_points_of_an_ended_episode_are_not_shown(make_env, tmp_path):
    short = "terminations.episode_length_s=0.14"  # 7 steps, a frame every 5
    env = make_env("obstacles=static", "num_envs=2", short, "perception=proximity_gru")
    recorder = Recorder(env, tmp_path / "a.mp4", 1.0, VideoOptions((WIDTH, HEIGHT)))
    shown = []
    for _ in range(10):
        env.step(torch.zeros(2, 12))
        recorder()
        shown.append(len(recorder._points(0)[0]) > 0)
    recorder.close()
    assert shown == [True] * 6 + [False] * 3 + [True]
