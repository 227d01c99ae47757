"""Motion within a frame: the bodies' poses at several moments of it."""

import math
from collections.abc import Sequence

import torch
import warp as wp

from .kernels.motion import Track, bound_swept_shapes, record_poses
from .launch import SplitLaunch
from .scene import RayScene, SensorView, empty_slots


class PoseTrack:
    """Poses of a scene's bodies at K + 1 evenly spaced moments of a frame.

    Within a segment a body moves evenly along a line and turns evenly about an axis, by the shorter way: for segments
    of h seconds, positions are off by at most max|acceleration| * h^2 / 8, angles likewise by angular acceleration, and
    constant velocities are exact. A body that went farther than ``jump`` in a segment has that segment's last pose
    all along; one without a valid pose in some segment is not there during the whole frame.

    Attributes:
        segments: K, the segments of a frame.
        arrays: The poses as the kernels read them.
    """

    def __init__(self, scene: RayScene, segments: int, jump: float = math.inf) -> None:
        """Allocates the poses.

        Args:
            scene: Whose bodies move.
            segments: K, at least 1.
            jump: A body that moves farther than this between two moments did not move there but jumped, metres.
        """
        self.segments, self._scene = segments, scene
        shape = (segments + 1, scene.num_envs, max(scene.num_bodies, 1))
        self._pos = torch.zeros(*shape, 3, dtype=torch.float64, device=scene.device)
        self._quat = torch.zeros(*shape, 4, dtype=torch.float64, device=scene.device)
        self._turn = torch.zeros_like(self._quat)
        self._oldest = torch.zeros(1, dtype=torch.int32, device=scene.device)
        self._newest = torch.full_like(self._oldest, segments)
        self._forget = torch.ones(scene.num_envs, dtype=torch.bool, device=scene.device)
        self._tensors = (self._pos, self._quat, self._turn, self._oldest, self._newest, self._forget)
        self._num_recorded, self._is_complete = 0, False
        self.arrays = self._as_arrays()
        args = [scene.wp_body_pos, scene.wp_body_quat, wp.from_torch(self._newest), min(jump, 3.0e38)]
        args += [wp.from_torch(self._forget), self.arrays.pos, self.arrays.quat, self.arrays.turn]
        self._record = scene.launch(record_poses, (), args, work_per_env=160 * scene.num_bodies)

    def record(self) -> None:
        """Takes the scene's poses as the newest moment; the oldest one is dropped."""
        self._newest.copy_(self._oldest)
        self._oldest.add_(1).remainder_(self.segments + 1)
        self._record()
        self._num_recorded += 1

    def record_end(self) -> None:
        """``record`` at the frame's end.

        Raises:
            ValueError: The moments within the frame are not the K - 1 that they must be.
        """
        if self._is_complete and self._num_recorded != self.segments - 1:
            raise ValueError(
                f"lidar.motion_segments={self.segments} needs record_poses() {self.segments - 1} times, evenly spaced,"
                f" between two casts, got {self._num_recorded}"
            )
        self.record()
        self._num_recorded, self._is_complete = 0, True

    def forget(self, env_ids: torch.Tensor | None = None) -> None:
        """Makes the next poses of some environments, (n,) int64, or of all, those of all moments."""
        if env_ids is None:
            self._forget.fill_(True)
            self._num_recorded, self._is_complete = 0, False
        else:
            self._forget.index_fill_(0, env_ids.to(self._forget.device), True)

    def state_dict(self) -> dict:
        """A copy of the poses."""
        counts = {"num_recorded": self._num_recorded, "is_complete": self._is_complete}
        return {"tensors": [tensor.clone() for tensor in self._tensors], **counts}

    def load_state_dict(self, state: dict) -> None:
        """Brings back what ``state_dict`` gave."""
        for own, saved in zip(self._tensors, state["tensors"], strict=True):
            own.copy_(saved)
        self._num_recorded, self._is_complete = state["num_recorded"], state["is_complete"]

    def _as_arrays(self) -> Track:
        track = Track()
        track.pos, track.quat = wp.from_torch(self._pos, dtype=wp.vec3d), wp.from_torch(self._quat, dtype=wp.quatd)
        track.turn, track.oldest = wp.from_torch(self._turn, dtype=wp.vec4d), wp.from_torch(self._oldest)
        track.segments = self.segments
        track.shape_body, track.shape_pose = self._scene.geometry.body, self._scene.geometry.pose
        return track


class SweptShapes:
    """Bounds of a scene's shapes over a frame in a viewer's frame, nearest first, refreshed by ``refresh``.

    Attributes:
        slots: The shapes as the kernels read them, without poses: every ray computes them for its own time.
    """

    def __init__(self, scene: RayScene, exclude_shapes: Sequence[int], view: SensorView, track: PoseTrack) -> None:
        self._scene, self._view, self._track = scene, view, track
        self.slots, viewed = empty_slots(scene, exclude_shapes, view)
        self._num_viewed = len(viewed)
        self._viewed: wp.array = wp.array(viewed or [0], dtype=wp.int32, device=scene.wp_device)
        self._visible: torch.Tensor | None = None
        self._launch = self._record()

    def refresh(self) -> None:
        """Bounds the shapes along the track."""
        if self._visible is not self._scene.visible_if_used:
            self._visible = self._scene.visible_if_used
            self._launch = self._record()
        self._launch()

    def _record(self) -> SplitLaunch:
        scene, view, track = self._scene, self._view, self._track
        args = [track.arrays, scene.geometry.radius, scene.wp_visible, self._viewed, self._num_viewed]
        args += [view.viewpoint, view.max_range + view.reach, self.slots]
        work = 160 * self._num_viewed * track.segments
        return scene.launch(bound_swept_shapes, (), args, work_per_env=work)
