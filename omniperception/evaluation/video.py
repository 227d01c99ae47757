"""Films one environment: a camera that follows the robot, its LiDAR points, command and velocity."""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

import imageio_ffmpeg
import torch

from omniperception.common.rotations import rotate_inverse, rotate_yaw
from omniperception.env.env import OmniEnv
from omniperception.evaluation.render import COMMAND, VELOCITY, Arrow, Renderer, View
from omniperception.perception import PdSampler
from omniperception.scene.rays import HitClass, ray_shapes

FPS = 25
BEHIND_M, ABOVE_M, AHEAD_M = 2.4, 1.45, 1.0
"""Place of the camera with respect to the robot, and how far ahead of the robot it looks."""
OVER_GROUND_M = 0.4
"""Least height of the camera above the ground below it, where the ground is not flat."""
FOLLOW_S, TURN_S = 0.25, 0.9
"""Time constants with which the camera follows the robot's position and heading."""
MIN_ARROW = 0.1
"""Speeds (m/s) below this have no arrow."""


class FollowCamera:
    """Stays behind and above the robot, smoothly."""

    def __init__(self, dt: float) -> None:
        """`dt` (s) is the time between two calls of `follow`."""
        self._keep_pos, self._keep_heading = math.exp(-dt / FOLLOW_S), math.exp(-dt / TURN_S)
        self._pos: torch.Tensor | None = None

    def cut(self) -> None:
        """Starts again at the robot's next pose."""
        self._pos = None

    def follow(self, foot_w: torch.Tensor, yaw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Eye and target (3,) (m) for a robot with heading `yaw` () (rad) over a point `foot_w` (3,) of the ground."""
        heading = torch.stack((yaw.cos(), yaw.sin()))
        if self._pos is None:
            self._pos, self._heading = foot_w, heading
        self._pos = self._keep_pos * self._pos + (1 - self._keep_pos) * foot_w
        self._heading = self._keep_heading * self._heading + (1 - self._keep_heading) * heading
        ahead = self._heading / self._heading.norm().clamp(min=1e-6)
        eye = self._pos + torch.cat((-BEHIND_M * ahead, ahead.new_tensor([ABOVE_M])))
        target = self._pos + torch.cat((AHEAD_M * ahead, ahead.new_tensor([0.2])))
        return eye, target


class Recorder:
    """Writes a video of one environment, to be called after every control step, and a still of a good moment.

    Attributes:
        frames_left: pictures still to be taken; none after `duration_s`.
    """

    def __init__(
        self,
        env: OmniEnv,
        path: Path,
        duration_s: float,
        width: int = 640,
        height: int = 360,
        env_id: int = 0,
    ) -> None:
        """
        Args:
            env: what is filmed.
            path: the mp4 file to write.
            duration_s: length of the video.
            width, height: its size, even numbers of pixels.
            env_id: the environment that is shown.
        """
        if width % 2 or height % 2:
            raise ValueError(f"a video of {width} x {height} pixels cannot be coded; use even numbers")
        self._env, self._id, self._size = env, env_id, (width, height)
        self._every = max(1, round(1 / (FPS * env.control_dt)))
        dt = self._every * env.control_dt
        self.frames_left = max(1, round(duration_s / dt))
        self._steps = 0
        self._shapes = ray_shapes(env.world)
        field = env.obstacles
        names = [] if field is None else [field.parts[k].name for k in field.varying]
        self._sized = self._shapes.indices(names)
        self._renderer = self._build_renderer(1, samples=1)
        self._camera = FollowCamera(dt)
        self._split = _split_elevation(env)
        self._blind_until = 0
        self._best: tuple[float, View] | None = None
        self._writer = imageio_ffmpeg.write_frames(
            str(path), (width, height), fps=1 / dt, codec="libx264", quality=6, macro_block_size=2
        )
        self._writer.send(None)

    def __call__(self) -> None:
        if self._env.done[self._id]:
            self._camera.cut()
            self._blind_until = self._env.sensing.tick + 1 if self._env.sensing is not None else 0
        self._steps += 1
        if self.frames_left == 0 or self._steps % self._every:
            return
        self.frames_left -= 1
        view = self._view()
        interest = self._interest()
        if self._best is None or interest > self._best[0]:
            self._best = interest, view
        self._writer.send(self._renderer.render(view).numpy().tobytes())

    def close(self) -> None:
        """Completes the video file."""
        self._writer.close()

    def write_still(self, path: Path, scale: int = 2) -> None:
        """Writes the most telling moment so far as a PNG, `scale` times the video's size."""
        if self._best is None:
            return
        write_png(path, self._build_renderer(scale, samples=2).render(self._best[1]))

    def _build_renderer(self, scale: int, samples: int) -> Renderer:
        width, height = (scale * pixels for pixels in self._size)
        threads = self._env.config.sim.num_threads or None
        device, sized = self._env.device, self._sized
        return Renderer(self._shapes, width, height, samples, device=device, num_threads=threads, sized=sized)

    def _view(self) -> View:
        env, state = self._env, self._env.state.kinematics
        pos, quat = env.sim.body_poses(self._shapes.bodies)
        base, yaw = state.base_pos_w[self._id], state.yaw[self._id]
        below = torch.stack((base[0], base[1], base[2] - env.state.base_height[self._id]))
        eye, target = self._camera.follow(below, yaw)
        if env.ground is not None:
            ground = env.ground.height(eye[None, :2], torch.tensor([self._id], device=env.device))[0]
            eye[2] = torch.maximum(eye[2], ground + OVER_GROUND_M)
        points, proximal = self._points()
        arrows = []
        shown = (env.command.value[:, :2], 0.16, COMMAND), (state.base_lin_vel_yaw, 0.07, VELOCITY)
        for velocity, width, colour in shown:
            vector = rotate_yaw(yaw[None], velocity[self._id, None])[0]
            if float(vector.norm()) >= MIN_ARROW:
                arrows.append(Arrow(base[:2].clone(), vector, width, colour))
        pose, field = (pos[self._id].clone(), quat[self._id].clone()), env.obstacles
        sizes = None if field is None else field.size[self._id, list(field.varying)]
        return View(eye, target, *pose, points, proximal, tuple(arrows), sizes)

    def _points(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Points (P, 3) (m, environment frame) of the episode's newest frame, and which are proximal."""
        sensing, device = self._env.sensing, self._env.device
        if sensing is None or sensing.frame is None or sensing.tick < self._blind_until:
            return torch.zeros(0, 3, device=device), torch.zeros(0, dtype=torch.bool, device=device)
        frame, config = sensing.frame, sensing.config
        if frame.ranges is None or frame.directions_s is None or frame.elevation is None:  # no network looks at points
            return torch.zeros(0, 3, device=device), torch.zeros(0, dtype=torch.bool, device=device)
        hit = frame.ranges[self._id].isfinite()
        points_s = frame.directions_s[self._id, hit] * frame.ranges[self._id, hit, None]
        points_c = _rotate(points_s.new_tensor(config.quat), points_s) + points_s.new_tensor(config.mount_pos)
        at, turned = (
            sensing.scene.body_pos[self._id, sensing.carrier],
            sensing.scene.body_quat[self._id, sensing.carrier],
        )
        return _rotate(turned, points_c) + at, frame.elevation[self._id, hit] > self._split

    def _interest(self) -> float:
        """Score of a picture: the robot walks ahead, and its LiDAR sees obstacles."""
        env = self._env
        speed = float(env.state.kinematics.base_lin_vel_yaw[self._id, 0])
        value = min(max(speed, 0.0), 0.8) + float(env.episode_length_buf[self._id] * env.control_dt > 2.0)
        frame = env.sensing.frame if env.sensing is not None else None
        if frame is not None and frame.class_id is not None:
            seen = float((frame.class_id[self._id] == HitClass.OBSTACLE).float().mean())
            value += min(10.0 * seen, 1.0)
        return value


def write_png(path: Path, image: torch.Tensor) -> None:
    """Writes an image (height, width, 3) uint8 as a PNG."""
    height, width, _ = image.shape
    lines = torch.cat((torch.zeros(height, 1, dtype=torch.uint8), image.flatten(1)), 1)  # 0: an unfiltered line
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(lines.numpy().tobytes(), 9)), (b"IEND", b"")
    chunks = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def _split_elevation(env: OmniEnv) -> float:
    """Elevation (rad) in the sensor frame above which a point is proximal."""
    sampler = env.config.sampler() if env.config.sampler is not None else None
    if isinstance(sampler, PdSampler):
        return sampler.split
    return math.radians(env.config.lidar.distal_below_deg) if env.config.lidar is not None else 0.0


def _rotate(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Turns vectors (n, 3) by one quaternion (4,)."""
    conjugate = quat * quat.new_tensor([1.0, -1.0, -1.0, -1.0])
    return rotate_inverse(conjugate.expand(len(vec), 4), vec)
