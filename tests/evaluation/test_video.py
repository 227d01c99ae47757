"""Pictures: what is where geometry says, and a file that plays."""

import math
import struct
import zlib

import imageio_ffmpeg
import pytest
import torch

from omniperception.evaluation.render import Arrow, Renderer, View
from omniperception.evaluation.video import FollowCamera, Recorder, write_png
from omniperception.lidar import Shape, ShapeKind
from omniperception.scene.rays import HitClass, RayShapes

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
    assert blueness(image[1, 2]) > 20  # the sky
    assert abs(blueness(image[34, 2])) < 20  # the ground is grey


def test_a_ball_covers_its_angular_size(renderer):
    # radius 0.5 m at 4 m: tan(asin(1/8)) = 0.126; focal length 18 / tan 30 deg = 31.2 pixels: 3.93 each side
    image = renderer.render(view())
    dark = image[18].amax(1) < 150
    assert abs(int(dark.sum()) - 2 * 18 / math.tan(math.radians(30)) * math.tan(math.asin(0.5 / 4))) <= 1.0


def test_left_in_the_world_is_left_in_the_picture(renderer):
    image = renderer.render(view(ball_pos=(0.0, 1.0, 1.0)))  # +y is left of a camera that looks along +x
    assert is_dark(image[18, 24]) and not is_dark(image[18, 40])


def test_points_hide_behind_things_and_have_two_colours(renderer):
    points = torch.tensor([[-1.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 1.5, 1.0]])
    proximal = torch.tensor([True, False, False])
    image = renderer.render(view(points=(points, proximal))).int()
    assert blueness(image[18, 32]) < -100  # the near, proximal point before the ball; the one behind it is hidden
    assert blueness(image[18, 20]) > 100


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


def test_more_samples_change_edges_only(renderer):
    fine = Renderer(BALL_ON_GROUND, WIDTH, HEIGHT, samples=3, fov_deg=60.0).render(view()).int()
    coarse = renderer.render(view()).int()
    assert ((fine - coarse).abs().amax(2) < 12).float().mean() > 0.85


def test_the_camera_stays_behind_the_robot():
    camera = FollowCamera(0.04)
    for step in range(200):
        yaw = torch.tensor(math.pi / 2)
        eye, target = camera.follow(torch.tensor([0.0, 0.02 * step, 0.3]), yaw)
    assert abs(float(eye[0])) < 1e-3 and eye[1] < 0.02 * 199 - 2.0 and target[1] > eye[1] + 3.0


def test_a_video_of_the_real_environment_plays(make_env, tmp_path):
    env = make_env("obstacles=static", "num_envs=2")
    recorder = Recorder(env, tmp_path / "a.mp4", duration_s=0.12, width=WIDTH, height=HEIGHT, env_id=1)
    for _ in range(10):
        env.step(torch.zeros(2, 12))
        recorder()
    recorder.close()
    assert recorder.frames_left == 0
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert frames == 3 and seconds == pytest.approx(0.12, abs=0.01)
    recorder.write_still(tmp_path / "a.png", scale=1)
    assert (tmp_path / "a.png").stat().st_size > 500


def test_lidar_points_lie_on_what_was_hit(make_env, tmp_path):
    env = make_env("obstacles=static", "num_envs=2", "perception=proximity_gru")
    recorder = Recorder(env, tmp_path / "a.mp4", duration_s=1.0, width=WIDTH, height=HEIGHT, env_id=1)
    for _ in range(5):
        env.step(torch.zeros(2, 12))
    points = recorder._view().points_w
    hit = env.sensing.frame.class_id[1][env.sensing.frame.ranges[1].isfinite()]
    recorder.close()
    on_ground = points[hit == HitClass.TERRAIN]
    assert len(points) == len(hit) and len(on_ground) > 20
    assert on_ground[:, 2].abs().max() < 1e-3


def test_points_of_an_ended_episode_are_not_shown(make_env, tmp_path):
    short = "terminations.episode_length_s=0.14"  # 7 steps, a frame every 5
    env = make_env("obstacles=static", "num_envs=2", short, "perception=proximity_gru")
    recorder = Recorder(env, tmp_path / "a.mp4", duration_s=1.0, width=WIDTH, height=HEIGHT)
    shown = []
    for _ in range(10):
        env.step(torch.zeros(2, 12))
        recorder()
        shown.append(len(recorder._points()[0]) > 0)
    recorder.close()
    assert shown == [True] * 6 + [False] * 3 + [True]


def test_odd_sizes_are_refused(make_env, tmp_path):
    env = make_env("lidar=none", "obstacles=none", "rewards=walk", "observations=walk", "num_envs=1")
    with pytest.raises(ValueError, match="even"):
        Recorder(env, tmp_path / "a.mp4", 1.0, 63, 36)


def test_a_png_holds_the_pixels(tmp_path):
    image = torch.arange(2 * 3 * 3, dtype=torch.uint8).reshape(2, 3, 3)
    write_png(tmp_path / "a.png", image)
    data = (tmp_path / "a.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and struct.unpack(">II", data[16:24]) == (3, 2)
    start = data.index(b"IDAT")
    (length,) = struct.unpack(">I", data[start - 4 : start])
    lines = zlib.decompress(data[start + 4 : start + 4 + length])
    assert lines == b"\0" + bytes(range(9)) + b"\0" + bytes(range(9, 18))
