"""The scene of the page: robot, ground, obstacles, points, arrows, sectors and heights of environment 0."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from omnilidar import LidarFrame
from omniperception.avoidance.sector_motion import NEARNESS_RANGE
from omniperception.env.heights import height_grid
from omniperception.env.sensing import split_elevation
from omniperception.evaluation.film.perceived import Perceived
from omniperception.scene.rays import HitClass
from omniperception.viewer import colours
from omniperception.viewer.colours import ARROWS, CLASSES, DISTAL, HEIGHTS, OBSTACLE, PROXIMAL, SECTORS, TERRAIN
from omniperception.viewer.meshes import grid_surface, robot_looks, triangles
from omniperception.viewer.page import add_points, show_points
from omniperception.viewer.session import Session

if TYPE_CHECKING:
    import viser

ROOT = "/world"
POINT_COLOURS = ("proximal/distal", "what it hit", "time", "intensity", "height")
GROUND_M, GROUND_STEP = 12.0, 0.1
"""Half side of the piece of uneven ground that is drawn, and its grid (m)."""
ARC_STEPS = 2
"""Straight pieces of a sector's arc."""
OVER_GROUND = 0.03
EYE, TARGET = (-3.2, -1.8, 2.2), (0.6, 0.0, 0.2)
"""Where the camera is at the beginning and what it looks at (m), from where the robot stands."""
STICK_REACH = 0.8
"""Distance (m) of the stick's ball from the base's middle at a command of 1 m/s."""

OnDrag = Callable[[int, str, tuple[float, float]], None]
OnClick = Callable[[int], None]


class Stage:
    """Nodes of the page's scene and what they show.

    Attributes:
        follows: whether the robot stays in the page's middle.
        points_by: one of POINT_COLOURS.
        point_size: m.
        shows: which of "points", "sectors", "arrows", "heights", "obstacles", "robot" are drawn.
        origin: (2,) place (m, environment frame) in the page's middle.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self.scene = server, server.scene
        self.follows, self.points_by, self.point_size = True, POINT_COLOURS[0], 0.025
        self.shows = {"points", "sectors", "arrows", "obstacles", "robot"}
        self.origin = np.zeros(2)
        self.on_drag: OnDrag = lambda part, phase, xy: None
        self.on_take_away: OnClick = lambda part: None
        self.on_push: Callable[[tuple[float, float]], None] = lambda direction: None
        self.on_stick: Callable[[tuple[float, float]], None] = lambda xy: None
        self.cast_shadows(False)
        server.initial_camera.position, server.initial_camera.look_at = EYE, TARGET
        self.show(session)

    def cast_shadows(self, on: bool) -> None:
        """Shadows are nice, and much to ask of a browser without a graphics card."""
        self.scene.configure_default_lights(cast_shadow=on)

    def look(self, clients: Iterable[Any]) -> None:
        """Has browsers look at the robot from where they did at the beginning."""
        x, y = self._session.env.state.kinematics.base_pos_w[0, :2].tolist()
        at = np.array([x - self.origin[0], y - self.origin[1], 0.0])
        for client in clients:
            with client.atomic():
                client.camera.position, client.camera.look_at = at + EYE, at + TARGET

    # ---- building ----------------------------------------------------------------------------------------------------

    def show(self, session: Session) -> None:
        """Puts another session on the stage."""
        self.scene.remove_by_name(ROOT)
        self._session, env = session, session.env
        self._root = self.scene.add_frame(ROOT, show_axes=False)
        self._links: list[Any] = []
        self._obstacles: dict[int, Any] = {}
        self._poses: dict[int, tuple] = {}
        self._sizes: dict[int, tuple[float, ...]] = {}
        self._obstacle_shapes = [
            k for k, shape in enumerate(session.shapes.shapes) if shape.class_id == HitClass.OBSTACLE
        ]
        self._part_of = {}
        if env.obstacles is not None:
            names = [part.name for part in env.obstacles.parts]
            self._part_of = {k: names.index(session.shapes.geom_names[k]) for k in self._obstacle_shapes}
        model = env.world.model
        looks = robot_looks(env.robot)
        self._link_bodies = tuple(model.body(look.body).id for look in looks)
        for k, look in enumerate(looks):
            handle: Any = self.scene.add_mesh_simple(
                f"{ROOT}/robot/{look.body}_{k}", look.vertices, look.faces, color=look.colour, flat_shading=False
            )
            handle.on_click(self._pushed)
            self._links.append(handle)
        self._ground: Any = None
        self._ground_trial = -1
        if env.ground is None:
            self.scene.add_grid(
                f"{ROOT}/ground",
                infinite_grid=True,
                cell_size=0.5,
                section_size=1.0,
                fade_distance=40.0,
                cell_color=(205, 209, 214),
                section_color=(170, 176, 184),
                plane_color=(226, 230, 235),
                plane_opacity=1.0,
                shadow_opacity=0.3,
            )
        self._points = add_points(self.scene, f"{ROOT}/points", self.point_size)
        self._arrows = {
            name: self.scene.add_arrows(
                f"{ROOT}/arrows/{name}",
                np.zeros((1, 2, 3)),
                rgb,
                shaft_radius=0.022,
                head_radius=0.05,
                head_length=0.11,
                visible=False,
            )
            for name, rgb in ARROWS.items()
        }
        self._lines = {
            name: self.scene.add_line_segments(
                f"{ROOT}/sectors/{name}", np.zeros((1, 2, 3)), rgb, thickness=0.03 if name == "perceived" else 0.015
            )
            for name, rgb in SECTORS.items()
        }
        self._heights = {
            name: self.scene.add_point_cloud(
                f"{ROOT}/heights/{name}", np.zeros((1, 3)), rgb, point_size=0.02, point_shape="diamond"
            )
            for name, rgb in HEIGHTS.items()
        }
        self._stick = self.scene.add_icosphere(f"{ROOT}/stick", 0.07, color=ARROWS["command"])
        self._stick.on_drag(lambda event: self.on_stick(self._on_level(event)))
        for k in self._obstacle_shapes:
            self._build_obstacle(k, self._size(k))

    def _build_obstacle(self, shape: int, size: tuple[float, ...]) -> None:
        mesh = triangles(self._session.shapes.shapes[shape], size)
        if mesh is None:
            return
        part = self._part_of[shape]
        handle: Any = self.scene.add_mesh_simple(
            f"{ROOT}/obstacles/{self._session.shapes.geom_names[shape]}",
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            color=OBSTACLE,
            flat_shading=True,
            visible=False,
        )

        def dragged(event: viser.SceneNodeDragEvent) -> None:
            self.on_drag(part, event.phase, self._on_level(event))

        handle.on_drag(dragged)
        handle.on_click(lambda event: self.on_take_away(part), modifier="shift")
        self._obstacles[shape], self._sizes[shape] = handle, size
        self._poses.pop(shape, None)

    def _size(self, shape: int) -> tuple[float, ...]:
        """Size of an obstacle's part in this trial, as its shape has it."""
        field, own = self._session.env.obstacles, self._session.shapes.shapes[shape]
        assert field is not None
        part = self._part_of[shape]
        if not field.parts[part].varies:
            return own.size
        return tuple(round(x, 4) for x in field.size[0, part].tolist()[: len(own.size)])

    # ---- drawing -----------------------------------------------------------------------------------------------------

    def draw(self, perceived: Perceived | None, true: Perceived, stick: bool) -> None:
        """Shows the session as it is now; `stick`: whether a person drives."""
        env = self._session.env
        with self._server.atomic(), torch.no_grad():
            base = env.state.kinematics.base_pos_w[0].numpy(force=True)
            self.origin = base[:2].copy() if self.follows else np.zeros(2)
            self._root.position = (-float(self.origin[0]), -float(self.origin[1]), 0.0)
            self._draw_robot()
            self._draw_ground()
            self._draw_obstacles()
            self._draw_arrows(perceived, true, stick)
            self._draw_sectors("perceived", perceived)
            self._draw_sectors("true", true)
            self._draw_heights("predicted", perceived)
            self._draw_heights("true", true)

    def draw_points(self) -> int:
        """Shows the newest cloud; returns how many points it has."""
        cloud = self._session.cloud
        if cloud is None or "points" not in self.shows:
            self._points.visible = False
            return 0
        assert cloud.valid is not None and cloud.points_w is not None
        hit = cloud.valid[0]
        points = cloud.points_w[0, hit].numpy(force=True)
        with self._server.atomic():
            self._points.visible = True
            self._points.position = (0.0, 0.0, self.point_size / 2)  # on what they lie on, not half in it
            show_points(self._points, points, self._point_colours(cloud, hit), self.point_size)
        return len(points)

    def _point_colours(self, cloud: LidarFrame, hit: torch.Tensor) -> np.ndarray:
        sensor, sensing = self._session.env.config.lidar, self._session.env.sensing
        assert sensor is not None and cloud.elevation is not None
        if self.points_by != "proximal/distal":
            return colours.of_points(cloud, self.points_by, CLASSES, sensor.period_s, top=2.0)
        split = split_elevation(None if sensing is None else sensing.history, sensor)
        proximal = cloud.elevation[0, hit].numpy(force=True) > split
        return np.where(proximal[:, None], np.array(PROXIMAL), np.array(DISTAL)).astype(np.uint8)

    def _draw_robot(self) -> None:
        pos, quat = self._session.env.sim.body_poses(self._link_bodies)
        visible = "robot" in self.shows
        for handle, at, turned in zip(self._links, pos[0].tolist(), quat[0].tolist(), strict=True):
            handle.position, handle.wxyz = at, turned
            _make_visible(handle, visible)

    def _draw_ground(self) -> None:
        """A ground that is not flat, around the origin; each trial may have another tile."""
        ground, trial = self._session.env.ground, len(self._session.outcomes)
        if ground is None or trial == self._ground_trial:
            return
        self._ground_trial = trial
        axis = torch.arange(-GROUND_M, GROUND_M + GROUND_STEP, GROUND_STEP, device="cpu")
        xy = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).reshape(1, -1, 2).to(self._session.env.device)
        z = ground.height(xy)[0].reshape(len(axis), -1).numpy(force=True)
        mesh = grid_surface(axis.numpy(), axis.numpy(), z)
        self._ground = self.scene.add_mesh_simple(
            f"{ROOT}/ground", np.asarray(mesh.vertices), np.asarray(mesh.faces), color=TERRAIN, flat_shading=True
        )

    def _draw_obstacles(self) -> None:
        field, visible = self._session.env.obstacles, "obstacles" in self.shows
        if field is None:
            return
        pos, quat, active = field.pos_w[0].tolist(), field.quat_w[0].tolist(), field.active[0].tolist()
        for shape, part in self._part_of.items():
            there = bool(active[part]) and visible
            size = self._size(shape) if there else self._sizes.get(shape, ())
            if there and size != self._sizes.get(shape):
                self._build_obstacle(shape, size)
            handle = self._obstacles.get(shape)
            if handle is None:
                continue
            pose = (pos[part], quat[part], there)
            if self._poses.get(shape) != pose:
                if there:
                    handle.position, handle.wxyz = pos[part], quat[part]
                _make_visible(handle, there)
                self._poses[shape] = pose

    def _draw_arrows(self, perceived: Perceived | None, true: Perceived, stick: bool) -> None:
        env, state = self._session.env, self._session.env.state
        base = state.kinematics.base_pos_w[0].numpy(force=True)
        yaw = float(state.kinematics.yaw[0])
        commanded = env.command.value[0, :2].numpy(force=True)
        shown = {
            "command": commanded,
            "velocity": state.kinematics.base_lin_vel_yaw[0].numpy(force=True),
            "V_avoid perceived": None if perceived is None else perceived.velocity,
            "V_avoid true": true.velocity,
        }
        for k, (name, velocity) in enumerate(shown.items()):
            handle, height = self._arrows[name], base[2] + 0.16 + 0.06 * k
            there = "arrows" in self.shows and velocity is not None and float(np.hypot(*velocity[:2])) > 0.05
            if there:
                assert velocity is not None
                start = np.array([base[0], base[1], height])
                handle.points = np.stack((start, start + STICK_REACH * np.array([*turned(velocity[:2], yaw), 0.0])))[
                    None
                ]
            _make_visible(handle, there)
        command = turned(commanded, yaw) * STICK_REACH
        self._stick.position = (base[0] + command[0], base[1] + command[1], base[2] + 0.16)
        self._stick.color = ARROWS["command"] if stick else (150, 170, 155)

    def _draw_sectors(self, name: str, seen: Perceived | None) -> None:
        handle = self._lines[name]
        there = "sectors" in self.shows and seen is not None and seen.sectors is not None
        if there:
            assert seen is not None and seen.sectors is not None
            state = self._session.env.state
            base = state.kinematics.base_pos_w[0].numpy(force=True)
            floor = float(base[2] - state.base_height[0]) + (2.0 if name == "perceived" else 1.0) * OVER_GROUND
            segments = sector_lines(seen.sectors, base[:2], float(state.kinematics.yaw[0]), floor)
            there = len(segments) > 0
            if there:
                handle.points = segments
        _make_visible(handle, there)

    def _draw_heights(self, name: str, seen: Perceived | None) -> None:
        handle = self._heights[name]
        there = "heights" in self.shows and seen is not None and seen.heights is not None
        if there:
            assert seen is not None and seen.heights is not None
            kinematics = self._session.env.state.kinematics
            base, yaw = kinematics.base_pos_w[0].numpy(force=True), float(kinematics.yaw[0])
            x, y = turned(height_grid().numpy().T, yaw)
            handle.points = np.stack((base[0] + x, base[1] + y, base[2] - seen.heights), 1).astype(np.float16)
        _make_visible(handle, there)

    # ---- the mouse ---------------------------------------------------------------------------------------------------

    def _on_level(self, event: viser.SceneNodeDragEvent) -> tuple[float, float]:
        """Where (m, environment frame) the mouse points at the height at which it took hold."""
        camera = np.asarray(event.client.camera.position)
        level = float(event.start_position[2])
        x, y = on_level(camera, np.asarray(event.end_position) - camera, level, np.asarray(event.end_position))
        return x + float(self.origin[0]), y + float(self.origin[1])

    def _pushed(self, event: Any) -> None:
        direction = np.asarray(event.ray_direction)[:2]
        norm = float(np.hypot(*direction))
        if norm > 1e-6:
            self.on_push((float(direction[0] / norm), float(direction[1] / norm)))


def _make_visible(handle: Any, visible: bool) -> None:
    """Only what changes is sent to the browsers."""
    if handle.visible != visible:
        handle.visible = visible


def on_level(start: np.ndarray, direction: np.ndarray, level: float, otherwise: np.ndarray) -> tuple[float, float]:
    """Where a ray from `start` (3,) along `direction` (3,) meets the plane z = level; `otherwise` where it does not."""
    share = (level - start[2]) / direction[2] if abs(direction[2]) > 1e-6 else -1.0
    point = start + share * direction if 0.0 < share < 1e3 else otherwise
    return float(point[0]), float(point[1])


def turned(vector: np.ndarray, yaw: float) -> np.ndarray:
    """A vector (2,), or several (2, n), turned by `yaw` (rad)."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def sector_lines(sectors: np.ndarray, base: np.ndarray, yaw: float, height: float) -> np.ndarray:
    """Arcs where the nearest obstacles are and lines along their velocities, (N, 2, 3) m, environment frame.

    Args:
        sectors: (S, 3) distance (m) and velocity (m/s, yaw-aligned frame).
        base: (2,) m.
        yaw: rad.
        height: m.
    """
    count = len(sectors)
    lines = []
    for k, (distance, *velocity) in enumerate(sectors.tolist()):
        if not distance < NEARNESS_RANGE:
            continue
        angles = yaw - math.pi + (k + np.linspace(0.04, 0.96, ARC_STEPS + 1)) * 2 * math.pi / count
        arc = base + distance * np.stack((np.cos(angles), np.sin(angles)), 1)
        lines += list(itertools.pairwise(arc))
        if math.hypot(*velocity) > 0.1:
            middle = arc[ARC_STEPS // 2]
            lines.append((middle, middle + 0.5 * turned(np.array(velocity), yaw)))
    flat = np.array(lines, np.float32).reshape(-1, 2, 2)
    return np.concatenate((flat, np.full((*flat.shape[:2], 1), height, np.float32)), -1)
