"""Draws pictures of one environment by casting camera rays with the LiDAR toolkit; no graphics library."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from omnilidar import RayScene
from omniperception.scene.rays import HitClass, RayShapes

COLOURS = {
    HitClass.TERRAIN: (0.60, 0.61, 0.62),
    HitClass.OBSTACLE: (0.82, 0.68, 0.45),
    HitClass.ROBOT: (0.13, 0.14, 0.18),
}
"""Linear RGB reflectance by what a ray has hit; the terrain's is that of the lighter squares."""
DARK_SQUARES = 0.76
SQUARE_M = 0.5
PROXIMAL, DISTAL = (0.95, 0.09, 0.03), (0.02, 0.22, 0.95)
"""Linear RGB of the LiDAR's points above and below the split elevation."""
COMMAND, VELOCITY = (0.05, 0.55, 0.16), (0.98, 0.80, 0.05)
"""Linear RGB of the arrows of the commanded and of the actual velocity."""
HORIZON, ZENITH = (0.78, 0.85, 0.92), (0.22, 0.42, 0.72)
SUN, SKY_LIGHT, GROUND_LIGHT = (0.88, 0.83, 0.74), (0.34, 0.38, 0.44), (0.20, 0.19, 0.17)
CAMERA_LIGHT = 0.36
"""Light from the camera that gives form to what the sun does not reach; none on level ground."""
TO_SUN = (-0.42, 0.46, 0.78)
FOG_M = 28.0
"""Distance (m) at which the ground has faded to 1/e into the horizon."""
POINT_M = 0.009
"""Radius of a LiDAR point as if it were a thing in the world."""
POINT_PX = 0.7, 2.6
"""Least and most of it in a picture of 720 lines."""
OPACITY, FAINT_M, LEAST_OPACITY = 0.8, 5.0, 0.3
"""Of points as near as what the camera looks at; distance (m) beyond that at which it has faded to 1/e; the least."""


@dataclass(frozen=True)
class Arrow:
    """An arrow painted on the ground.

    Attributes:
        start_w: (2,) where it begins, m.
        vector_w: (2,) from there to its tip, m.
        width: of its shaft, m.
        colour: linear RGB.
    """

    start_w: torch.Tensor
    vector_w: torch.Tensor
    width: float
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """Content of one picture, in the environment's frame.

    Attributes:
        eye_w: (3,) position of the camera, m.
        target_w: (3,) where it looks, m.
        body_pos: (num_bodies, 3) positions of the moving bodies in the order of `RayShapes.bodies`, m.
        body_quat: (num_bodies, 4) their orientations.
        points_w: (P, 3) LiDAR points, m.
        proximal: (P,) bool which of them are proximal.
        arrows: painted in this order.
        sizes: (k, 3) sizes of the shapes that the renderer was told to resize, m.
    """

    eye_w: torch.Tensor
    target_w: torch.Tensor
    body_pos: torch.Tensor
    body_quat: torch.Tensor
    points_w: torch.Tensor
    proximal: torch.Tensor
    arrows: tuple[Arrow, ...] = ()
    sizes: torch.Tensor | None = None


class Renderer:
    """A pinhole camera. The picture is cut into strips, environments of a ray scene, that CPU threads share.

    Attributes:
        width, height: size of the picture, pixels.
    """

    def __init__(
        self,
        shapes: RayShapes,
        width: int = 640,
        height: int = 360,
        samples: int = 1,
        fov_deg: float = 46.0,
        device: str | torch.device = "cpu",
        num_threads: int | None = None,
        sized: tuple[int, ...] = (),
    ) -> None:
        """
        Args:
            shapes: shapes that are drawn.
            width, height: size of the picture, pixels.
            samples: rays per pixel along each axis, averaged.
            fov_deg: vertical field of view.
            device: of the rays.
            num_threads: CPU threads; None for all cores.
            sized: indices of the shapes whose sizes each view gives.
        """
        self.width, self.height, self._samples, self._sized = width, height, samples, sized
        self._columns, self._rows = width * samples, height * samples
        self._focal = 0.5 * self._rows / math.tan(math.radians(fov_deg) / 2)
        strips = max(n for n in range(1, min(self._rows, 32) + 1) if self._rows % n == 0)
        self._scene = RayScene(shapes.shapes, strips, len(shapes.bodies), device, num_threads)
        device = self._scene.device
        classes = [shape.class_id for shape in shapes.shapes]
        self._terrain = tuple(k for k, c in enumerate(classes) if c == HitClass.TERRAIN)
        self._robot = tuple(k for k, c in enumerate(classes) if c == HitClass.ROBOT)
        self._class = torch.tensor([*classes, -1], device=device)  # a miss, shape -1, takes the last entry
        self._albedo = torch.tensor([*(COLOURS[HitClass(c)] for c in classes), (0.0,) * 3], device=device)
        x = torch.arange(self._columns, device=device) + 0.5 - self._columns / 2
        y = torch.arange(self._rows, device=device) + 0.5 - self._rows / 2
        y, x = torch.meshgrid(y, x, indexing="ij")
        rays = torch.stack((x, y, torch.full_like(x, self._focal)), -1).flatten(0, 1)
        self._rays_c = rays / rays.norm(dim=1, keepdim=True)
        self._to_sun = _vector(TO_SUN, device) / math.hypot(*TO_SUN)

    def place(self, body_pos: torch.Tensor, body_quat: torch.Tensor, sizes: torch.Tensor | None) -> None:
        """Puts the bodies where a view has them, for `free_share`."""
        self._scene.body_pos.copy_(body_pos)
        self._scene.body_quat.copy_(body_quat)
        if self._sized:
            assert sizes is not None  # which a view is to give
            self._scene.set_sizes(self._sized, sizes)

    def free_share(self, start_w: torch.Tensor, ends_w: torch.Tensor) -> torch.Tensor:
        """Shares (n,) of the ways from `start_w` (3,) to `ends_w` (n, 3) that are free, 1 where nothing is in the way.

        Terrain and obstacles are in the way, the robot is not.
        """
        ways = (ends_w - start_w).expand(self._scene.num_envs, -1, -1)
        hits = self._scene.cast(start_w.expand_as(ways), ways, exclude_shapes=self._robot)
        return (hits.ranges[0] / ways[0].norm(dim=1)).clamp(max=1.0)

    def render(self, view: View) -> torch.Tensor:
        """The picture, (height, width, 3) uint8 on the CPU."""
        self.place(view.body_pos, view.body_quat, view.sizes)
        axes = _camera_axes(view.eye_w, view.target_w)
        rays = self._rays_c @ axes
        ranges, classes, arrows, colour = self._shade(view, rays)
        colour = torch.where((classes >= 0)[:, None], colour, _sky(rays))
        shape = self._rows, self._columns
        colour = colour.clamp(0.0, 1.0).pow(1 / 2.2).unflatten(0, shape)
        slack = torch.where(classes == HitClass.ROBOT, 0.02, 0.06 + 0.02 * ranges)
        seen_to = torch.where(arrows, 0.0, ranges + slack)  # points would cover the arrows
        self._draw_points(colour, seen_to.unflatten(0, shape), view, axes)
        if self._samples > 1:
            colour = torch.nn.functional.avg_pool2d(colour.permute(2, 0, 1), self._samples).permute(1, 2, 0)
        return (colour * 255.0 + 0.5).to(torch.uint8).cpu()

    def _shade(self, view: View, rays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Distance (m) and class of what each ray has hit, whether it is an arrow, and its linear colour."""
        strips = (self._scene.num_envs, -1)
        origins = view.eye_w.expand_as(rays)
        hits = self._scene.cast(origins.unflatten(0, strips), rays.unflatten(0, strips), normals=True)
        assert hits.normals_w is not None  # asked for
        ranges, shape = hits.ranges.flatten(), hits.shape_id.flatten().long()
        normals, classes = hits.normals_w.flatten(0, 1), self._class[shape]
        points = view.eye_w + torch.where(classes >= 0, ranges, 0.0)[:, None] * rays
        albedo = self._albedo[shape]
        ground = (classes == HitClass.TERRAIN).nonzero().flatten()
        footprint = ranges[ground] / self._focal
        stretched = footprint / rays[ground, 2].abs().clamp(min=1e-3)
        albedo[ground] *= DARK_SQUARES + (1 - DARK_SQUARES) * _checkers(
            points[ground, :2] / SQUARE_M, stretched / SQUARE_M
        )
        painted = torch.zeros_like(ranges, dtype=torch.bool)
        for arrow in view.arrows:
            cover = (0.5 - _arrow_distance(points[ground, :2], arrow) / footprint).clamp(0.0, 1.0)[:, None]
            albedo[ground] += cover * (_vector(arrow.colour, rays.device) - albedo[ground])
            painted[ground] |= cover[:, 0] > 0
        facing = normals @ self._to_sun
        light = facing.clamp(min=0.0) * ~self._shadowed(points, normals, (classes >= 0) & (facing > 0))
        up = (0.5 + 0.5 * normals[:, 2:]).clamp(0.0, 1.0)
        fill = CAMERA_LIGHT * (normals * rays).sum(1, keepdim=True).neg().clamp(min=0.0) * (1.0 - up)
        sun, sky, earth, horizon = (_vector(c, rays.device) for c in (SUN, SKY_LIGHT, GROUND_LIGHT, HORIZON))
        colour = albedo * (light[:, None] * sun + earth + up * (sky - earth) + fill)
        clear = torch.where(classes >= 0, torch.exp(-((ranges / FOG_M) ** 2)), 0.0)[:, None]
        return ranges, classes, painted, colour * clear + horizon * (1 - clear)

    def _shadowed(self, points: torch.Tensor, normals: torch.Tensor, lit: torch.Tensor) -> torch.Tensor:
        """Tell whether each of the points that face the sun lies in a shadow."""
        shadowed = torch.zeros_like(lit)
        ids = lit.nonzero().flatten()
        strips = self._scene.num_envs
        padding = -len(ids) % strips
        if len(ids) == 0:
            return shadowed
        ids = torch.cat((ids, ids[:1].expand(padding)))
        origins = (points[ids] + 2e-3 * normals[ids]).unflatten(0, (strips, -1))
        towards = self._to_sun.expand_as(origins)
        hits = self._scene.cast(origins, towards, max_range=12.0, exclude_shapes=self._terrain)
        shadowed[ids] = hits.shape_id.flatten() >= 0
        return shadowed

    def _draw_points(self, colour: torch.Tensor, seen_to: torch.Tensor, view: View, axes: torch.Tensor) -> None:
        """Draws discs where LiDAR points are, nearer ones over farther ones, the smaller and fainter the farther.

        Args:
            colour: (rows, columns, 3) picture, drawn into.
            seen_to: (rows, columns) distance (m) up to which a point is before what a pixel shows.
            view: what is drawn.
            axes: (3, 3) of the camera.
        """
        offset = view.points_w - view.eye_w
        order = offset.norm(dim=1).argsort(descending=True)
        offset, proximal = offset[order], view.proximal[order]
        right, down, ahead = (offset @ axes.T).unbind(1)
        column = self._focal * right / ahead.clamp(min=1e-6) + self._columns / 2
        row = self._focal * down / ahead.clamp(min=1e-6) + self._rows / 2
        least, most = (px * self._rows / 720 for px in POINT_PX)
        reach = math.ceil(max(most, 1.0))
        inside = (ahead > 0.1) & (column >= reach) & (column < self._columns - reach)
        inside &= (row >= reach) & (row < self._rows - reach)
        row, column, proximal = row[inside], column[inside], proximal[inside]
        distance = offset[inside].norm(dim=1)
        radius = (self._focal * POINT_M / distance).clamp(max(least, 0.5), max(most, 1.0))
        beyond = (distance - (view.target_w - view.eye_w).norm()).clamp(min=0.0)
        opacity = (OPACITY * torch.exp(-beyond / FAINT_M)).clamp(min=LEAST_OPACITY)
        device = colour.device
        dots = torch.where(proximal[:, None], _vector(PROXIMAL, device), _vector(DISTAL, device)).pow(1 / 2.2)
        for down_px in range(-reach, reach + 1):
            for right_px in range(-reach, reach + 1):
                i, j = row.long() + down_px, column.long() + right_px
                away = torch.hypot(i + 0.5 - row, j + 0.5 - column)
                cover = opacity * (radius + 0.5 - away).clamp(0.0, 1.0) * (distance <= seen_to[i, j])
                drawn = cover > 0
                i, j, cover = i[drawn], j[drawn], cover[drawn, None]
                colour[i, j] += cover * (dots[drawn] - colour[i, j])


def _camera_axes(eye_w: torch.Tensor, target_w: torch.Tensor) -> torch.Tensor:
    """(3, 3) the camera's axes in rows: right, down, ahead; z is up in the world."""
    ahead = target_w - eye_w
    ahead = ahead / ahead.norm()
    right = torch.linalg.cross(ahead, _vector((0.0, 0.0, 1.0), ahead.device))
    right = right / right.norm()
    return torch.stack((right, torch.linalg.cross(ahead, right), ahead))


def _sky(rays: torch.Tensor) -> torch.Tensor:
    height = rays[:, 2:].clamp(0.0, 1.0).sqrt()
    horizon = _vector(HORIZON, rays.device)
    return horizon + height * (_vector(ZENITH, rays.device) - horizon)


def _checkers(xy: torch.Tensor, width: torch.Tensor) -> torch.Tensor:
    """A board of unit squares of 0 and 1 averaged over boxes of a width (n,), so that it fades out far away; (n, 1).

    The closed form is Inigo Quilez's 'Filtering the checkerboard pattern'.
    """
    width = width.clamp(min=1e-4)[:, None]
    low, high = (xy - 0.5 * width) / 2, (xy + 0.5 * width) / 2
    mean = 2.0 * (((low - low.floor()) - 0.5).abs() - ((high - high.floor()) - 0.5).abs()) / width
    return 0.5 - 0.5 * mean.prod(1, keepdim=True)


def _arrow_distance(xy_w: torch.Tensor, arrow: Arrow) -> torch.Tensor:
    """Signed distance (m) of points on the ground to an arrow's outline, negative inside."""
    length = float(arrow.vector_w.norm())
    along_w = arrow.vector_w / max(length, 1e-6)
    offset = xy_w - arrow.start_w
    along = offset @ along_w
    across = (offset[:, 0] * along_w[1] - offset[:, 1] * along_w[0]).abs()
    head, half_head = min(2.4 * arrow.width, length), 1.3 * arrow.width
    neck = length - head
    shaft = torch.maximum(across - arrow.width / 2, torch.maximum(-along, along - neck))
    slope = (across * head - half_head * (length - along)) / math.hypot(head, half_head)
    return torch.minimum(shaft, torch.maximum(slope, neck - along))


def _vector(values: tuple[float, ...], device: torch.device) -> torch.Tensor:
    return torch.tensor(values, device=device)


def shown(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    """A linear colour as a picture shows it, 0 to 255."""
    red, green, blue = (round(255 * c ** (1 / 2.2)) for c in colour)
    return red, green, blue
