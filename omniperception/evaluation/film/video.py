"""Films environments: a camera that follows each robot, its LiDAR points, command and velocity, what it perceives."""

from __future__ import annotations

import contextlib
import errno
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import torch
from PIL import Image
from torch import nn

from omniperception.common.rotations import rotate, rotate_yaw
from omniperception.env.env import OmniEnv
from omniperception.env.sensing import split_elevation
from omniperception.evaluation.film.camera import FollowCamera
from omniperception.evaluation.film.overlay import PERCEIVED, TRUE, legend, sector_plot
from omniperception.evaluation.film.perceived import perceived, true_sectors
from omniperception.evaluation.film.render import COMMAND, DISTAL, PROXIMAL, VELOCITY, Arrow, Renderer, View, shown
from omniperception.evaluation.film.video_options import VideoOptions
from omniperception.scene.rays import HitClass, ray_shapes
from omnirobot.common.errors import naming

FPS = 25
MIN_ARROW = 0.1
"""Speeds (m/s) below this have no arrow."""
INSET, MARGIN = 0.27, 0.02
"""Side of the inset and distance of what is drawn over a picture from its edges, by the picture's height."""
GAP_PX = 2
"""Between the pictures of a grid."""
LEAST_INSET = 40
"""Pixels below which there is no inset."""


@dataclass(frozen=True)
class Moment:
    """What a panel shows: the scene, and obstacles by sector as perceived and true, where the policy perceives any."""

    view: View
    perceived: np.ndarray | None = None
    true: np.ndarray | None = None


class Recorder:
    """Writes a video of environments, to be called after every control step, and a still of a good moment.

    Attributes:
        frames_left: pictures still to be taken; none after `duration_s`.
    """

    def __init__(
        self,
        env: OmniEnv,
        path: Path,
        duration_s: float,
        options: VideoOptions | None = None,
        policy: object = None,
    ) -> None:
        """
        Args:
            env: what is filmed.
            path: the mp4 file to write.
            duration_s: length of the video.
            options: size, environments, camera; None: as they are by default.
            policy: who acts; a network that tells obstacles by sector has an inset of them.

        Raises:
            ConfigError: an environment does not exist.
        """
        self._env, self._options = env, options or VideoOptions()
        self._options.check_fits(env.num_envs)
        self._actor = policy if isinstance(policy, nn.Module) else None
        self._every = max(1, round(1 / (FPS * env.control_dt)))
        dt = self._every * env.control_dt
        self.frames_left = max(1, round(duration_s / dt))
        self._steps = 0
        self._shapes = ray_shapes(env.world)
        field = env.obstacles
        names = [] if field is None else [field.parts[k].name for k in field.varying]
        self._sized = self._shapes.indices(names)
        self._renderer = self._build_renderer(samples=1)
        ids = self._options.video_envs
        self._cameras = {k: FollowCamera(dt, self._options.camera) for k in ids}
        self._blind_until = dict.fromkeys(ids, 0)
        self._best: tuple[float, list[Moment]] | None = None
        width, height = self._options.video_size
        self._begun, self._path = False, path.resolve()  # a relative one may look like an option of ffmpeg, or a URL
        with open(path, "ab"):  # ffmpeg would not say why it cannot be
            pass
        self._writer = imageio_ffmpeg.write_frames(
            *(str(self._path), (width, height)),
            fps=1 / dt,
            codec="libx264",
            quality=6,
            macro_block_size=2,
            ffmpeg_log_level="fatal",
        )
        self._writer.send(None)

    def __call__(self) -> None:
        sensing = self._env.sensing
        for k, camera in self._cameras.items():
            if self._env.done[k]:
                camera.cut()
                self._blind_until[k] = sensing.tick + 1 if sensing is not None else 0
        self._steps += 1
        if self.frames_left == 0 or self._steps % self._every:
            return
        self.frames_left -= 1
        moments = [self._moment(k) for k in self._cameras]
        interest = sum(self._interest(k) for k in self._cameras)
        if self._best is None or interest > self._best[0]:
            self._best = interest, moments
        self._begun = True
        with contextlib.suppress(OSError):  # ffmpeg has ended, which close tells
            return self._writer.send(self._picture(self._renderer, moments).tobytes())
        self.close()

    def close(self) -> None:
        """Completes the video file.

        Raises:
            OSError: it is not whole.
        """
        self._writer.close()
        try:
            if self._begun:
                imageio_ffmpeg.count_frames_and_secs(str(self._path))
        except RuntimeError:
            why = "ffmpeg could not write a whole video, as where no space is left"
            raise OSError(errno.ENOSPC, why, str(self._path)) from None

    def write_still(self, path: Path) -> None:
        """Writes the most telling moment so far as a PNG of the video's size."""
        if self._best is not None:
            with naming(path):
                self._picture(self._build_renderer(samples=2), self._best[1]).save(path)

    def _build_renderer(self, samples: int) -> Renderer:
        threads = self._env.config.sim.num_threads or None
        device, sized = self._env.device, self._sized
        return Renderer(self._shapes, *self._options.panel, samples, device=device, num_threads=threads, sized=sized)

    @property
    def _has_inset(self) -> bool:
        return INSET * self._options.panel[1] >= LEAST_INSET

    def _picture(self, renderer: Renderer, moments: list[Moment]) -> Image.Image:
        """The panels side by side, with what is drawn over them."""
        (columns, _), (width, height) = self._options.grid, self._options.panel
        gap = GAP_PX if len(moments) > 1 else 0
        picture = Image.new("RGB", (self._options.video_size[0], self._options.video_size[1]))
        for k, moment in enumerate(moments):
            panel = Image.fromarray(renderer.render(moment.view).numpy())
            if moment.perceived is not None and self._has_inset:
                plot, margin = sector_plot(moment.perceived, moment.true, round(INSET * height)), round(MARGIN * height)
                panel.paste(plot, (width - plot.width - margin, margin), plot)
            picture.paste(panel.crop((0, 0, width - gap, height - gap)), (k % columns * width, k // columns * height))
        colours = {"command": shown(COMMAND), "velocity": shown(VELOCITY)}
        if self._env.sensing is not None:
            colours = {"proximal points": shown(PROXIMAL), "distal points": shown(DISTAL), **colours}
        if self._has_inset and any(moment.perceived is not None for moment in moments):
            colours |= {"obstacles as perceived": PERCEIVED, "as they are": TRUE}
        key, margin = legend(colours, picture.height), round(MARGIN * picture.height)
        if key.width + 2 * margin <= picture.width:
            picture.paste(key, (margin, picture.height - key.height - margin), key)
        return picture

    def _moment(self, env_id: int) -> Moment:
        env = self._env
        view = self._view(env_id)
        seen = None
        if self._actor is not None:
            seen = perceived(self._actor, env.get_observations(), env.state.reference, env_id)
        if seen is None or seen.sectors is None:
            return Moment(view)
        return Moment(view, seen.sectors, true_sectors(env, env_id))

    def _view(self, env_id: int) -> View:
        env, state = self._env, self._env.state.kinematics
        pos, quat = (poses[env_id].clone() for poses in env.sim.body_poses(self._shapes.bodies))
        field = env.obstacles
        sizes = None if field is None else field.size[env_id, list(field.varying)]
        self._renderer.place(pos, quat, sizes)
        base, yaw = state.base_pos_w[env_id], state.yaw[env_id]
        below = torch.stack((base[0], base[1], base[2] - env.state.base_height[env_id]))
        eye, target = self._cameras[env_id].follow(below, yaw, self._renderer.free_share)
        points, proximal = self._points(env_id)
        arrows = []
        painted = (env.command.value[:, :2], 0.16, COMMAND), (state.base_lin_vel_yaw, 0.07, VELOCITY)
        for velocity, width, colour in painted:
            vector = rotate_yaw(yaw[None], velocity[env_id, None])[0]
            if float(vector.norm()) >= MIN_ARROW:
                arrows.append(Arrow(base[:2].clone(), vector, width, colour))
        return View(eye, target, pos, quat, points, proximal, tuple(arrows), sizes)

    def _points(self, env_id: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Points (P, 3) (m, environment frame) of the episode's newest frame, and which are proximal."""
        sensing, device = self._env.sensing, self._env.device
        nothing = torch.zeros(0, 3, device=device), torch.zeros(0, dtype=torch.bool, device=device)
        if sensing is None or sensing.sliced or sensing.frame is None or sensing.tick < self._blind_until[env_id]:
            return nothing
        frame, config = sensing.frame, sensing.config
        if frame.ranges is None or frame.directions_s is None or frame.elevation is None:  # no network looks at points
            return nothing
        hit = frame.ranges[env_id].isfinite()
        points_s = frame.directions_s[env_id, hit] * frame.ranges[env_id, hit, None]
        points_c = rotate(points_s.new_tensor(config.quat), points_s) + points_s.new_tensor(config.mount_pos)
        at, turned = (pose[env_id, sensing.carrier] for pose in (sensing.scene.body_pos, sensing.scene.body_quat))
        return rotate(turned, points_c) + at, frame.elevation[env_id, hit] > split_elevation(sensing.history, config)

    def _interest(self, env_id: int) -> float:
        """Score of a picture: the robot walks ahead, and its LiDAR sees obstacles."""
        env = self._env
        speed = float(env.state.kinematics.base_lin_vel_yaw[env_id, 0])
        value = min(max(speed, 0.0), 0.8) + float(env.episode_length_buf[env_id] * env.control_dt > 2.0)
        frame = env.sensing.frame if env.sensing is not None and not env.sensing.sliced else None
        if frame is not None and frame.class_id is not None:
            seen = float((frame.class_id[env_id] == HitClass.OBSTACLE).float().mean())
            value += min(10.0 * seen, 1.0)
        return value
