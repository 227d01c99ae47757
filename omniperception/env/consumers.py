"""Consumers of LiDAR frames: each says what it needs of a cloud, and keeps what it makes of it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import torch

from omnilidar import LidarFrame, SectorDistances
from omnilidar.launch import constant
from omniperception.avoidance.coverage import Coverage, kept_to_covered, levelled
from omniperception.common.stateful import Stateful, copied
from omniperception.env.partial_frames import PartialFrames
from omniperception.perception import Attitude, Sampler
from omniperception.scene.rays import HitClass

if TYPE_CHECKING:
    from omniperception.env.sensing import LidarSensing

NEVER = 2**31
"""Frames since something was seen that has not been seen in this episode."""


class FrameConsumer(Stateful):
    """Takes what it wants of every LiDAR frame while its clouds exist, and keeps it until the next one.

    Attributes:
        outputs: what it reads of a frame, names from `omnilidar.OUTPUTS`; nothing else is computed.
        whole: whether the clouds of all environments have to exist at once, and last until the next frame.
        stage: under which its time is counted.
        sensing: the LiDAR whose frames it takes.
    """

    outputs: Collection[str] = ()
    whole = False
    stage = "rays"
    sensing: LidarSensing

    def attach(self, sensing: LidarSensing) -> None:
        """Prepares for the frames of a LiDAR; allocates memory."""
        self.sensing = sensing

    def take(self, envs: slice, frame: LidarFrame) -> None:
        """Takes what it wants of the newest clouds of environments `envs`, which the next slice overwrites."""

    def finish(self) -> None:
        """The clouds of all environments have been taken."""

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forgets what it has of environments (n,), whose episodes begin."""


class FrameHistory(FrameConsumer):
    """The points that a network sees of the newest frames.

    Where a frame is lost, the last one that came is repeated, with no motion of the base; the motion of the next one
    that comes is that since the last one that came.

    Attributes:
        frames: (num_envs, length, num_points + rows, 3) sampled points in the sensor frame divided by the maximum
            range, newest last, with the rows of the odometry, if there is one.
        count: (num_envs, 1) int64 how many of the newest frames are valid; 0 until one has come.
        version: another number whenever `frames` is another tensor, as it is after each frame and each reset.
    """

    saved = ("frames", "count")
    stage = "sampling"

    def __init__(self, sampler: Sampler, length: int, shown: bool = True) -> None:
        """
        Args:
            sampler: what the network sees of a cloud.
            length: frames kept.
            shown: whether there are frames; otherwise the network never has one.
        """
        self.sampler, self._length, self._shown = sampler, length, shown
        self.outputs = ("ranges", "directions_s", "elevation", "azimuth") if shown else ()
        self.version = 0

    def attach(self, sensing: LidarSensing) -> None:
        super().attach(sensing)
        rows = 0 if sensing.odometry is None else sensing.odometry.num_rows
        self._newest = torch.zeros(sensing.num_envs, self.sampler.num_points + rows, 3, device=sensing.device)
        self.frames = self._newest[:, None].repeat(1, self._length, 1, 1)
        self.count = torch.zeros(sensing.num_envs, 1, dtype=torch.int64, device=sensing.device)

    def take(self, envs: slice, frame: LidarFrame) -> None:
        if self._shown:
            assert frame.ranges is not None and frame.directions_s is not None
            assert frame.elevation is not None and frame.azimuth is not None
            sensor, points = self.sensing.config, self._newest[envs, : self.sampler.num_points]
            attitude = Attitude(self.sensing.attitude[envs].contiguous(), sensor.mount_pos, sensor.quat)
            self.sampler(frame.ranges, frame.directions_s, frame.elevation, frame.azimuth, points, attitude)

    def finish(self) -> None:
        if not self._shown:
            return
        sensing, fresh, newest = self.sensing, self.sensing.fresh, self._newest
        torch.where(fresh[:, None, None], newest, self.frames[:, -1], out=newest)
        if sensing.odometry is not None:
            newest[:, self.sampler.num_points :] = sensing.odometry.take(fresh, sensing.late_steps)
        self.frames = torch.cat((self.frames[:, 1:], newest[:, None]), 1)  # observations keep the tensor of before
        self.count.add_(fresh[:, None] | (self.count > 0)).clamp_(max=self._length)
        self.version += 1

    def reset(self, env_ids: torch.Tensor) -> None:
        self.count.index_fill_(0, env_ids, 0)
        self.frames = self.frames.index_fill(0, env_ids, 0.0)
        self.version += 1

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.version += 1


class CoveredSectors(FrameConsumer):
    """Takes points away from partial frames, before others see them, and knows which directions the rest covers."""

    outputs = ("ranges", "directions_s")
    saved = ("coverage",)

    def __init__(self, partial: PartialFrames, least: torch.Tensor) -> None:
        """Args: partial: what is lost; least: (NUM_SECTORS,) bins of a covered sector, see `least_bins`."""
        self._partial, self._least = partial, least

    def attach(self, sensing: LidarSensing) -> None:
        super().attach(sensing)
        self.coverage = Coverage(sensing.num_envs, self._least.to(sensing.device))

    def take(self, envs: slice, frame: LidarFrame) -> None:
        assert frame.ranges is not None and frame.directions_s is not None
        if envs.start == 0:
            self.coverage.begin_frame()
        self._partial.take_away(frame.ranges, frame.directions_s, envs)
        attitude = self.sensing.attitude[envs]
        directions_l = levelled(frame.directions_s, attitude, constant(self.sensing.config.quat, attitude.device))
        self.coverage.add_frame(frame.ranges, directions_l, self.sensing.fresh[envs], envs)

    def reset(self, env_ids: torch.Tensor) -> None:
        self.coverage.reset(env_ids)

    def known_to_be_free(self, command: torch.Tensor) -> torch.Tensor:
        """(num_envs, 3) the commanded v_x, v_y (m/s) and yaw rate (rad/s), slowed down where nobody looked."""
        return torch.cat((kept_to_covered(command[:, :2], self.coverage.covered), command[:, 2:]), 1)


class Sightings(FrameConsumer):
    """When rays last hit each of some obstacles; a frame that is repeated shows again what it has shown.

    Attributes:
        unseen: (num_envs, O) int64 frames of the history since.
    """

    outputs = ("shape_id",)
    saved = ("unseen",)

    def __init__(self, obstacles: Sequence[str]) -> None:
        """Args: obstacles: geoms, in the order of `unseen`."""
        self._obstacles = tuple(obstacles)

    def attach(self, sensing: LidarSensing) -> None:
        super().attach(sensing)
        count = len(self._obstacles)
        self._obstacle_of = torch.full((len(sensing.shapes.shapes) + 1,), count, device=sensing.device)
        index = 1 + torch.tensor(sensing.shapes.indices(self._obstacles))  # 0: a miss; all else: one obstacle more
        self._obstacle_of[index] = torch.arange(count, device=sensing.device)
        self.unseen = torch.full((sensing.num_envs, count), NEVER, device=sensing.device)

    def take(self, envs: slice, frame: LidarFrame) -> None:
        assert frame.shape_id is not None
        hit, unseen = self._obstacle_of[frame.shape_id.long() + 1], self.unseen[envs]
        seen = torch.zeros(len(hit), unseen.shape[1] + 1, dtype=torch.bool, device=hit.device)
        seen = torch.where(self.sensing.fresh[envs, None], seen.scatter_(1, hit, True)[:, :-1], unseen == 0)
        self.unseen[envs] = torch.where(seen, 0, unseen + 1)

    def reset(self, env_ids: torch.Tensor) -> None:
        self.unseen.index_fill_(0, env_ids, NEVER)


class DistalRange(FrameConsumer):
    """Means of the noise-free distal ranges, capped."""

    outputs = ("true_ranges", "elevation")
    saved = ("_means",)

    def __init__(self) -> None:
        self._means: dict[float, torch.Tensor] = {}

    def mean(self, max_distance: float) -> torch.Tensor:
        """(num_envs,) mean of the distal ranges (m) of the newest frame, each capped at `max_distance`; the cap before
        the first frame. A cap is averaged from the first frame on that follows its first read."""
        if max_distance not in self._means:
            cap = torch.full((self.sensing.num_envs,), max_distance, device=self.sensing.device)
            self._means[max_distance] = cap
        return self._means[max_distance]

    def take(self, envs: slice, frame: LidarFrame) -> None:
        assert frame.elevation is not None and frame.true_ranges is not None
        distal = frame.elevation < torch.pi / 180 * self.sensing.config.distal_below_deg
        for cap, mean in self._means.items():
            capped = frame.true_ranges.clamp(max=cap) * distal
            mean[envs] = capped.sum(1) / distal.sum(1).clamp(min=1)

    def reset(self, env_ids: torch.Tensor) -> None:
        for cap, mean in self._means.items():
            mean.index_fill_(0, env_ids, cap)


class SectorRanges(FrameConsumer):
    """Horizontal distances from the base to the nearest obstacle hit by sector, without noise."""

    outputs = ("true_ranges", "directions_s", "class_id")
    stage = "sectors"

    def __init__(self, out: torch.Tensor) -> None:
        """Args: out: (num_envs, num_sectors) m, where they are written."""
        self._out = out

    def attach(self, sensing: LidarSensing) -> None:
        super().attach(sensing)
        sensor, scene, self._launches = sensing.config, sensing.scene, dict[int, SectorDistances]()
        for envs, frame in zip(sensing.lidar.env_slices, sensing.lidar.slice_frames, strict=True):
            assert frame.true_ranges is not None and frame.directions_s is not None and frame.class_id is not None
            self._launches[envs.start] = SectorDistances(
                frame.true_ranges,
                frame.directions_s,
                frame.class_id,
                scene.body_pos[envs],
                scene.body_quat[envs],
                sensing.base,
                sensor.mount_pos,
                sensor.quat,
                obstacle_class=int(HitClass.OBSTACLE),
                max_distance=sensor.max_range,
                num_sectors=self._out.shape[1],
                num_threads=sensing.num_threads,
                out=self._out[envs],
                carrier=sensing.carrier,
            )

    def take(self, envs: slice, frame: LidarFrame) -> None:
        self._launches[envs.start]()


class Clouds(FrameConsumer):
    """The clouds of all environments, for terms that read `EnvState.cloud`."""

    whole = True

    def __init__(self, outputs: Collection[str]) -> None:
        self.outputs = outputs

    def state_dict(self) -> dict:
        lidar = self.sensing.lidar
        read = sorted(lidar.outputs) if self.sensing.has_frame else ()
        return {name: copied(getattr(lidar.frame, name)) for name in read}

    def load_state_dict(self, state: dict) -> None:
        self.sensing.has_frame = bool(state)
        for name, values in state.items():
            getattr(self.sensing.lidar.frame, name).copy_(values)
