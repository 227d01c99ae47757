"""The scan lab: any sensor in a room of walking people, its noise, motion, range and rate under sliders."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from omnilidar import (
    AngularJitter,
    DistanceNoise,
    Dropout,
    GaussianNoise,
    Lidar,
    LidarFrame,
    MaskNoise,
    MixedPixels,
    Noise,
)
from omniperception.common.rotations import multiply, rotate, yaw_quat
from omniperception.env.sensing import SensorConfig
from omniperception.viewer import charts
from omniperception.viewer.colours import of_points, scale
from omniperception.viewer.meshes import triangles
from omniperception.viewer.options import PageOptions, Room
from omniperception.viewer.page import Page, add_points, check_free, show_points

DT = 0.02
"""Time (s) between two poses of everything."""
MOST_RAYS = 20_000
OUTPUTS = (
    *("points_w", "points_s", "ranges", "true_ranges", "valid", "class_id", "shape_id", "time_s", "intensity"),
    "row",
)
COLOURED_BY = ("what it hit", "range", "error", "time", "intensity", "height")
FORMATS = (".ply", ".pcd", ".las", ".npz", ".mcap")
SEGMENTS = 5
"""Pieces into which a frame is cut for motion distortion, or fewer where its steps do not divide by it."""


@dataclass
class Knobs:
    """What the sliders say.

    Attributes:
        num_rays: points kept of a frame.
        period_s: time (s) from frame to frame, a multiple of DT.
        min_range, max_range: m.
        gaussian, jitter_deg, dropout, mask, distance, mixed_deg: strength of each kind of noise; 0 is none.
        distortion: whether each point is cast from the poses at its own time.
        drive: speed (m/s) of the robot on its circle.
        turn: its yaw rate (rad/s) besides.
        walk: speed (m/s) of the people.
    """

    num_rays: int = 4000
    period_s: float = 0.1
    min_range: float = 0.1
    max_range: float = 20.0
    gaussian: float = 0.0
    jitter_deg: float = 0.0
    dropout: float = 0.0
    mask: float = 0.0
    distance: float = 0.0
    mixed_deg: float = 0.0
    distortion: bool = False
    drive: float = 0.0
    turn: float = 0.0
    walk: float = 0.8

    @classmethod
    def of(cls, sensor: SensorConfig) -> Knobs:
        """Those of a sensor's preset, without noise."""
        period = max(1, round(sensor.period_s / DT)) * DT
        rays = min(sensor.num_rays, MOST_RAYS)
        return cls(rays, period, sensor.min_range, sensor.max_range, distortion=sensor.motion_segments > 0)

    def noise(self) -> tuple[Noise, ...]:
        """The models of noise that there are."""
        models: list[tuple[float, Noise]] = [
            (self.gaussian, GaussianNoise(sigma=self.gaussian)),
            (self.jitter_deg, AngularJitter(sigma_deg=self.jitter_deg or 0.1)),
            (self.dropout, Dropout(ratio=self.dropout)),
            (self.mask, MaskNoise(ratio=self.mask)),
            (self.distance, DistanceNoise(ratio=self.distance)),
            (self.mixed_deg, MixedPixels(divergence_deg=self.mixed_deg or 0.1)),
        ]
        return tuple(model for amount, model in models if amount > 0)

    @property
    def steps(self) -> int:
        """Poses from frame to frame."""
        return max(1, round(self.period_s / DT))

    @property
    def segments(self) -> int:
        """Pieces of a frame for motion distortion; 0 without."""
        return max(k for k in range(1, SEGMENTS + 1) if self.steps % k == 0) if self.distortion else 0


@dataclass
class Walkers:
    """People who walk straight on and turn back at the edge.

    Attributes:
        pos: (n, 2) m.
        heading: (n,) rad.
    """

    low: np.ndarray
    high: np.ndarray
    pos: np.ndarray
    heading: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def within(cls, extent: tuple[tuple[float, float], tuple[float, float]], count: int) -> Walkers:
        """So many, spread over a rectangle and 0.5 m off its edge."""
        low, high = (np.array([axis[side] for axis in extent]) for side in (0, 1))
        low, high = low + 0.5, high - 0.5
        random = np.random.default_rng(1)
        return cls(low, high, low + random.random((count, 2)) * (high - low), random.random(count) * 2 * math.pi)

    def advance(self, distance: float) -> None:
        """Lets each walk so far (m)."""
        way = np.stack((np.cos(self.heading), np.sin(self.heading)), 1)
        self.pos = self.pos + distance * way
        over, under = self.pos > self.high, self.pos < self.low
        way = np.where(over, -np.abs(way), np.where(under, np.abs(way), way))
        self.heading = np.arctan2(way[:, 1], way[:, 0])
        self.pos = np.clip(self.pos, self.low, self.high)


class Bench:
    """A sensor on a robot that moves through a room of walking people.

    Attributes:
        knobs, sensor: what is set, and the preset.
        frame: the newest scan; None before the first.
        frames: scans so far.
        time_s: s.
    """

    def __init__(self, room: Room, sensor: SensorConfig, knobs: Knobs) -> None:
        self._room, self.sensor, self.knobs = room, sensor, knobs
        self._walkers = Walkers.within(room.extent, len(room.movers))
        self._own = torch.tensor([k for k in range(room.scene.num_bodies) if k not in room.movers])
        self._rest = room.scene.body_pos[0, self._own].clone(), room.scene.body_quat[0, self._own].clone()
        self._along, self._turned = 0.0, 0.0
        self.frame: LidarFrame | None = None
        self.frames, self.time_s, self._step = 0, 0.0, 0
        self.build()

    def put(self, sensor: SensorConfig) -> None:
        """Takes another sensor."""
        self.sensor = sensor
        moved = {name: getattr(self.knobs, name) for name in ("drive", "turn", "walk")}
        self.knobs = replace(Knobs.of(sensor), **moved)
        self.build()

    def build(self) -> None:
        """Makes the sensor as the knobs say; ValueError where they cannot be."""
        room, knobs, sensor = self._room, self.knobs, self.sensor
        excluded = room.robot.built_geoms(sensor.exclude_geoms, room.robot_geoms)
        pattern = sensor.scan_pattern()
        config = replace(
            sensor,
            num_rays=min(int(knobs.num_rays), pattern.points_per_frame(knobs.period_s)),
            period_s=knobs.period_s,
            min_range=knobs.min_range,
            max_range=knobs.max_range,
            motion_segments=knobs.segments,
        )
        self._lidar = Lidar(
            config,
            pattern,
            room.scene,
            room.bodies[sensor.mount_body or room.robot.base],
            exclude_shapes=[room.robot_geoms[geom] for geom in excluded],
            noise=knobs.noise(),
            outputs=OUTPUTS,
            reflectivity=room.reflectivity,
        )
        self.frame, self._step = None, 0

    def step(self) -> bool:
        """Moves everything by DT and casts where a frame is due; tells whether one was."""
        self._move()
        self._step += 1
        self.time_s += DT
        knobs = self.knobs
        if self._step % knobs.steps == 0:
            self.frame = self._lidar.cast(self.time_s)
            self.frames += 1
            return True
        if knobs.segments and self._step % (knobs.steps // knobs.segments) == 0:
            self._lidar.record_poses()
        return False

    def _move(self) -> None:
        knobs, scene = self.knobs, self._room.scene
        self._walkers.advance(knobs.walk * DT)
        headings = yaw_quat(torch.tensor(self._walkers.heading)).to(scene.body_quat)
        for k, body in enumerate(self._room.movers):
            x, y = self._walkers.pos[k]
            scene.body_pos[0, body] = scene.body_pos.new_tensor([x, y, 0.0])
            scene.body_quat[0, body] = headings[k]
        self._along += knobs.drive * DT
        self._turned += knobs.turn * DT
        self._place_robot()

    def _place_robot(self) -> None:
        """The robot on a circle of 1 m about the place where it stood, turned about its own base."""
        scene, (pos, quat) = self._room.scene, self._rest
        base = pos[self._own == self._room.bodies[self._room.robot.base]][0]
        turn = yaw_quat(torch.tensor(self._turned)).to(quat).expand_as(quat)
        shift = base.new_tensor([math.sin(self._along), 1.0 - math.cos(self._along), 0.0])
        scene.body_pos[0, self._own] = base + shift + rotate(turn, pos - base)
        scene.body_quat[0, self._own] = multiply(turn, quat)


class Lab(Page):
    """The page of the scan lab.

    Attributes:
        bench: the sensor and what is around it.
    """

    def __init__(
        self, room: Room, sensors: Mapping[str, Callable[[], SensorConfig]], out: Path, options: PageOptions
    ) -> None:
        self._room, self._sensors, self._out = room, sensors, out
        check_free(options)
        self.name = next(iter(sensors))
        sensor = sensors[self.name]()
        self.bench = Bench(room, sensor, Knobs.of(sensor))
        super().__init__(options, "Scan lab", DT)
        self.coloured_by, self.point_size = COLOURED_BY[0], 0.02
        self._sliders: dict[str, Any] = {}
        self._bodies: list[tuple[int, Any]] = []
        self._build_scene()
        self._build_controls()

    def advance(self) -> float:
        self.serve_requests()
        if self.bench.step():
            self._draw_points()
        wait = self.clock.stepped()
        if self.server.get_clients() and self.clock.picture_is_due():
            self._draw_bodies()
        if self.status_is_due():
            self._draw_status()
        return wait

    # ---- what a person asks for --------------------------------------------------------------------------------------

    def choose(self, name: str) -> None:
        """Takes another sensor."""
        self.bench.put(self._sensors[name]())
        self.name = name
        for key, slider in self._sliders.items():
            slider.value = getattr(self.bench.knobs, key)
        self.say(f"{name}: {self.bench.sensor.scan_pattern().points_per_second:,.0f} points/s by its maker")

    def set(self, key: str, value: float | bool) -> None:
        """Turns a knob; what cannot be is refused and the knob goes back."""
        before = self.bench.knobs
        self.bench.knobs = replace(before, **{key: value})  # type: ignore[arg-type]  # each knob has its own type
        if key in ("drive", "turn", "walk"):
            return
        try:
            self.bench.build()
        except ValueError:
            self.bench.knobs = before
            self.bench.build()
            self._sliders[key].value = getattr(before, key)
            raise

    def export(self, suffix: str) -> Path:
        """Writes the newest scan with all of its columns; the format is that of the suffix."""
        frame = self.bench.frame
        if frame is None:
            raise ValueError("there is no scan yet")
        self._out.mkdir(parents=True, exist_ok=True)
        path = self._out / f"{self.name}_{self.bench.frames:06d}{suffix}"
        frame.save(path, points="points_w", time_s=self.bench.time_s)
        self.say(f"wrote {path}")
        return path

    # ---- the page ----------------------------------------------------------------------------------------------------

    def _build_scene(self) -> None:
        scene, room = self.server.scene, self._room
        scene.configure_default_lights(cast_shadow=False)  # much to ask of a browser without a graphics card
        self.server.initial_camera.position = (-4.5, -4.5, 4.5)
        self.server.initial_camera.look_at = (0.8, 0.0, 0.5)
        moving = sorted({shape.body for shape in room.scene.shapes if shape.body >= 0})
        self._bodies = [(body, scene.add_frame(f"/body_{body}", show_axes=False)) for body in moving]
        for k, shape in enumerate(room.scene.shapes):
            mesh = triangles(shape)
            if mesh is None or k in room.open_side:
                continue
            colour = room.colours[shape.class_id]
            parent = f"/body_{shape.body}" if shape.body >= 0 else "/room"
            scene.add_mesh_simple(
                f"{parent}/shape_{k}",
                np.asarray(mesh.vertices),
                np.asarray(mesh.faces),
                color=_rgb(colour),
                position=shape.pos,
                wxyz=shape.quat,
                flat_shading=True,
                opacity=0.35 if shape.body < 0 else None,
            )
        self._points = add_points(scene, "/points", self.point_size)

    def _build_controls(self) -> None:
        gui = self.server.gui
        self._status = gui.add_html("")
        sensor = gui.add_dropdown("sensor", tuple(dict.fromkeys(self._sensors)), initial_value=self.name)
        self.on_change(sensor, self.choose)
        with gui.add_folder("Scan"):
            self._slider("num_rays", "rays a frame", 100, MOST_RAYS, 100)
            self._slider("period_s", "period (s)", DT, 0.5, DT)
            self._slider("min_range", "least range (m)", 0.0, 3.0, 0.05)
            self._slider("max_range", "most range (m)", 0.5, 300.0, 0.5)
        with gui.add_folder("Noise"):
            self._slider("gaussian", "Gaussian (m)", 0.0, 0.2, 0.005)
            self._slider("jitter_deg", "jitter (deg)", 0.0, 2.0, 0.05)
            self._slider("dropout", "lost (share)", 0.0, 1.0, 0.01)
            self._slider("mask", "masked (share)", 0.0, 0.5, 0.01)
            self._slider("distance", "relative error", 0.0, 0.3, 0.01)
            self._slider("mixed_deg", "mixed, beam (deg)", 0.0, 2.0, 0.05)
        with gui.add_folder("Motion"):
            box = gui.add_checkbox("points at their own time", self.bench.knobs.distortion, hint="motion distortion")
            self.on_change(box, partial(self.set, "distortion"))
            self._sliders["distortion"] = box
            self._slider("drive", "robot drives (m/s)", 0.0, 3.0, 0.1)
            self._slider("turn", "robot turns (rad/s)", -4.0, 4.0, 0.1)
            self._slider("walk", "people walk (m/s)", 0.0, 3.0, 0.1)
        with gui.add_folder("See"):
            colour = gui.add_dropdown("points coloured by", COLOURED_BY)
            self.on_change(colour, partial(setattr, self, "coloured_by"))
            size = gui.add_slider("point size (m)", 0.005, 0.08, 0.005, self.point_size)
            self.on_change(size, partial(setattr, self, "point_size"))
            gui.add_html(charts.legend({name: _rgb(self._room.colours[k]) for k, name in self._room.names.items()}))
        with gui.add_folder("Export"):
            form = gui.add_dropdown("format", FORMATS)
            button = gui.add_button("write this scan")
            button.on_click(lambda event: self.ask(lambda: self._hand_over(form.value, event.client)))

    def _slider(self, key: str, label: str, low: float, high: float, step: float) -> None:
        value = min(max(getattr(self.bench.knobs, key), low), high)
        slider = self.server.gui.add_slider(label, low, high, step, value)
        self.on_change(slider, partial(self.set, key))
        self._sliders[key] = slider

    def _hand_over(self, suffix: str, client: Any) -> None:
        path = self.export(suffix)
        if client is not None:
            client.send_file_download(path.name, path.read_bytes())

    def _draw_bodies(self) -> None:
        scene = self._room.scene
        pos, quat = scene.body_pos[0].tolist(), scene.body_quat[0].tolist()
        with self.server.atomic():
            for body, frame in self._bodies:
                frame.position, frame.wxyz = pos[body], quat[body]

    def _draw_points(self) -> None:
        frame = self.bench.frame
        if frame is None or not self.server.get_clients():
            return
        assert frame.valid is not None and frame.points_w is not None
        hit = frame.valid[0]
        points = frame.points_w[0, hit].numpy(force=True)
        with self.server.atomic():
            show_points(self._points, points, self._colours(frame, hit), self.point_size)
        self.clock.clouds += 1

    def _colours(self, frame: LidarFrame, hit: torch.Tensor) -> np.ndarray:
        knobs = self.bench.knobs
        if self.coloured_by in ("range", "error"):
            assert frame.ranges is not None and frame.true_ranges is not None
            ranges, true = (one[0, hit].numpy(force=True) for one in (frame.ranges, frame.true_ranges))
            return scale(ranges / knobs.max_range if self.coloured_by == "range" else np.abs(ranges - true) / 0.2)
        classes = {kind: _rgb(colour) for kind, colour in self._room.colours.items()}
        return of_points(frame, self.coloured_by, classes, knobs.period_s, top=2.6)

    def _draw_status(self) -> None:
        frame, clock = self.bench.frame, self.clock
        hits = 0 if frame is None or frame.valid is None else int(frame.valid.sum())
        lines = [
            f"{self.name}: {hits:,} of {0 if frame is None else frame.num_rays:,} rays hit",
            f"real time x {clock.reached:.2f} · {clock.clouds_hz:.0f} scans/s shown · {clock.dropped} pictures dropped",
            self.warning,
            self.message,
        ]
        self._status.content = charts.lines(lines)


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
