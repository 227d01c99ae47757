"""Terrain from files: height maps, floor plans and meshes of whole places, as one height field with places to start."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar
from zipfile import BadZipFile

import mujoco
import numpy as np
from PIL import Image

from omnilidar.mesh_files import AXES, read_mesh, unit_hint, up_of
from omniperception.common.checked import (
    AsTuple,
    AtLeastOne,
    Cell,
    Count,
    Inside,
    NonNegative,
    Place2,
    Positive,
    Share,
    checked,
)
from omniperception.scene.height_field import EDGE, add_height_field

MAX_POINTS = 16_000_000
"""Grid points of a map."""
_OFF_LINE = (1.3e-4, 0.7e-4)
"""Share of a cell by which a mesh is looked at beside the grid, so that points lie on no edge of it."""


@checked("terrain.start")
class StartsConfig:
    """Places where robots start: level, free of walls, on ground that hangs together.

    Attributes:
        num: places, one of which is drawn at every reset; fewer where fewer are found.
        radius: half side (m) of the free square around a place.
        step: largest difference (m) of heights in that square.
        climb: largest difference (m) of neighbouring grid points of ground that hangs together; walls have more.
        inside: (x, y) m of a point on the ground that is meant; None: the ground of the largest area.
        seed: of the choice.
    """

    num: AtLeastOne = 64
    radius: Positive = 0.5
    step: Positive = 0.05
    climb: Positive = 0.2
    inside: Place2 | None = None
    seed: Count = 0


@checked("terrain")
class MapTerrainConfig:
    """A height field from a file; what kind of file, a subclass says.

    An environment starts at one of the places found, which is the origin of its frame, at the height of the ground
    there. Where it leaves the file's area, its episode ends as a time-out; the ground goes on for a metre as at the
    edge.

    Attributes:
        file: path, relative to the working directory.
        cell: distance (m) of grid points.
        start: where robots start.
        friction: sliding friction coefficient of the ground; it holds for every contact with the ground.
        restitution: the ground's coefficient of restitution in [0, 1]; a contact has half of it, see `ground_solrefs`.
    """

    file: str
    cell: Cell = 0.05
    start: StartsConfig = StartsConfig()
    friction: NonNegative = 0.8
    restitution: Share = 0.0

    suffixes: ClassVar[tuple[str, ...]] = (".png",)
    columns: ClassVar[int] = 1
    curriculum: ClassVar[None] = None

    def __post_init__(self) -> None:
        if Path(self.file).suffix.lower() not in self.suffixes:
            raise ValueError(f"terrain.file={self.file} must end with {' or '.join(self.suffixes)}")
        if not Path(self.file).is_file():
            raise ValueError(f"terrain.file={self.file} does not exist (working directory: {Path.cwd()})")

    def read(self) -> tuple[np.ndarray, tuple[float, float]]:
        """(rows, cols) heights (m), x along columns, y along rows, and where (m) the first point is in the file."""
        raise NotImplementedError

    def check_footing(self, footing: float, beside: float) -> None:
        """Refuses places where `RobotConfig.footing` (m) reaches beyond the ground that is known to be level, from as
        far beside them (m) as robots start.

        Raises:
            ValueError: they would be found, and robots start on top of what stands beside them.
        """
        cells = math.ceil(footing / self.cell) + round(beside / self.cell) + 1  # as Ground.highest looks
        if round(self.start.radius / self.cell) < cells:
            raise ValueError(
                f"terrain.start.radius={self.start.radius} is too small for robot.footing={footing} with"
                f" terrain.cell={self.cell} and commands.spawn up to {beside:g} m away: robots would"
                f" start on top of what stands beside a place; give terrain.start.radius={cells * self.cell:g}"
            )

    def floor(self, heights: np.ndarray) -> np.ndarray:
        """(rows, cols) bool: which points of (rows, cols) heights (m) may belong to the ground that is meant."""
        return np.ones(heights.shape, bool)

    @cached_property
    def _map(self) -> tuple[np.ndarray, tuple[float, float]]:
        heights, first = self.read()
        least = 1 + 2 * round(self.start.radius / self.cell)
        if min(heights.shape) < least or heights.size > MAX_POINTS:
            raise ValueError(
                f"terrain.file={self.file} has {heights.shape[1]} x {heights.shape[0]} points {self.cell} m apart;"
                f" {least} x {least} to {MAX_POINTS} in all were expected; change terrain.cell"
            )
        if not np.isfinite(heights).all():
            raise ValueError(f"terrain.file={self.file} holds heights that are not finite; fill them")
        border = round(EDGE / self.cell)
        return np.pad(heights, border, mode="edge"), (first[0] - border * self.cell, first[1] - border * self.cell)

    def height_map(self) -> np.ndarray:
        """(rows, cols) float64 heights (m), x along columns, y along rows."""
        return self._map[0]

    @cached_property
    def places(self) -> np.ndarray:
        """(num, 2) int64 grid points (column, row) where robots start."""
        heights, (x, y) = self._map
        near = None
        if self.start.inside is not None:
            near = tuple(round((at - low) / self.cell) for at, low in zip(self.start.inside, (x, y), strict=True))
            if not (0 <= near[0] < heights.shape[1] and 0 <= near[1] < heights.shape[0]):
                raise ValueError(f"terrain.start.inside={list(self.start.inside)} lies beside the map")
        found = free_places(heights, self.cell, self.start, near, self.floor(heights))
        if not len(found):
            where, mend = "nowhere", ""
            if near is not None:
                given = list(self.start.inside or ())
                where = f"around terrain.start.inside={given}, {heights[near[1], near[0]]:.2f} m high, nowhere"
                mend = "name another point, "
            raise ValueError(
                f"terrain.file={self.file} has no place to start: {where} is ground level to {self.start.step} m within"
                f" {self.start.radius} m (its heights: {heights.min():.2f} to {heights.max():.2f} m); {mend}lower"
                " terrain.start.radius, raise terrain.start.step, or change terrain.cell"
            )
        return found

    @property
    def levels(self) -> int:
        """Number of places."""
        return len(self.places)

    def starts(self) -> np.ndarray:
        """(columns, levels, 2) int64 grid points (column, row) at which environments have their origins."""
        return self.places[None]

    def column_kinds(self) -> tuple[str, ...]:
        return ("map",)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the height field on a kinematic body, so that every environment can have a place of its own.

        Its lowest point is at 0: heights above the sea would lose millimetres where they are float32.
        """
        heights = self.height_map()
        add_height_field(spec, heights - heights.min(), self.cell, self.friction, self.restitution)


_Heights = Annotated[tuple[float, float], AsTuple, "the heights [black, white] (m)"]


@checked("terrain")
class HeightMapConfig(MapTerrainConfig):
    """Heights from a grey PNG or a NumPy file, a grid point for each pixel; (0, 0) is the map's middle.

    A picture lies as it is seen: x to its right, y to its top. Rows of a NumPy file go along y.

    Attributes:
        heights: of a picture: heights (m) of black and of white. A NumPy file has metres.
    """

    heights: _Heights | None = None

    suffixes: ClassVar[tuple[str, ...]] = (".png", ".npy")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.heights is not None) != (Path(self.file).suffix.lower() == ".png"):
            raise ValueError(
                f"terrain.heights={self.heights} with terrain.file={self.file}: a PNG needs the heights [black, white]"
                " (m), a .npy file has metres and takes null"
            )

    def read(self) -> tuple[np.ndarray, tuple[float, float]]:
        if self.heights is None:
            heights = read_array(self.file)
        else:
            black, white = self.heights
            heights = black + (white - black) * read_image(self.file)
        return heights, _first_of(heights, self.cell)


@checked("terrain")
class FloorPlanConfig(MapTerrainConfig):
    """Walls from a PNG of a floor plan, a grid point for each pixel: dark is wall. The frame is that of a height map.

    Attributes:
        wall_height: (m) above the floor, which is at 0.
        threshold: a pixel darker than this (0 black, 1 white) is wall.
    """

    wall_height: float = 1.5
    threshold: Inside = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.wall_height > self.start.climb:
            raise ValueError(
                f"terrain.wall_height={self.wall_height} must be above terrain.start.climb={self.start.climb}: walls"
                " are what cannot be climbed"
            )

    def read(self) -> tuple[np.ndarray, tuple[float, float]]:
        heights = np.where(read_image(self.file) < self.threshold, float(self.wall_height), 0.0)
        return heights, _first_of(heights, self.cell)

    def floor(self, heights: np.ndarray) -> np.ndarray:
        return heights == 0.0


@checked("terrain")
class PlaceConfig(MapTerrainConfig):
    """A whole place from a mesh, seen from above: a height field has no overhangs, so what is above `ceiling` is left
    out, and below a table's top it is solid. x and y are the mesh's.

    Attributes:
        scale: metres per unit of the file, beside the unit that its format states.
        up: axis of the file that points up, one of `AXES`; with 'y' its -z is y here. None: as the format says (y of
            glTF, COLLADA's <up_axis>), else z, unless the mesh looks as if it were y.
        ceiling: height (m) in the file's frame above which nothing counts; a wall that goes on above ends there, if
            its faces are wound as those of a solid are, outwards. Where the ground's face down, all are turned round.
        outside: height (m) where there is nothing; None: that of the lowest point.
    """

    scale: Positive = 1.0
    up: str | None = None
    ceiling: float | None = None
    outside: float | None = None

    suffixes: ClassVar[tuple[str, ...]] = (".stl", ".obj", ".ply", ".glb", ".gltf", ".dae")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up not in (*AXES, None):
            raise ValueError(f"terrain.up={self.up} must be {', '.join(AXES)} or null")

    def read(self) -> tuple[np.ndarray, tuple[float, float]]:
        vertices, triangles = read_mesh(self.file, self.scale, self.up)
        corners = vertices[triangles]
        if self.up is None:
            self._check_upright(corners)
        said = unit_hint(self.file, corners, self.scale, "terrain.scale")
        low, high = corners.min((0, 1)), corners.max((0, 1))
        cols, rows = (int((high[k] - low[k]) / self.cell + 1e-6) + 1 for k in (0, 1))
        if cols * rows > MAX_POINTS:
            raise ValueError(
                f"terrain.file={self.file} is {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m, too large for"
                f" terrain.cell={self.cell}; {said or f'change it or terrain.scale={self.scale}'}"
            )
        if min(cols, rows) < 2:
            raise ValueError(
                f"terrain.file={self.file} is {high[0] - low[0]:.2g} x {high[1] - low[1]:.2g} m, smaller than"
                f" terrain.cell={self.cell}; {said or f'change it or terrain.scale={self.scale}'}"
            )
        if said:
            warnings.warn(said, stacklevel=2)
        x, y = (low[k] + self.cell * np.arange(num) for k, num in ((0, cols), (1, rows)))
        heights, upside_down = seen_from_above(corners, x, y, self.ceiling)
        if upside_down and self.ceiling is not None:
            said = f"terrain.file={self.file} is wound inside out, its ground faces down: its triangles are turned over"
            warnings.warn(said, stacklevel=2)
            heights, _ = seen_from_above(corners[:, ::-1], x, y, self.ceiling)
        empty = np.isneginf(heights)
        if empty.all():
            raise ValueError(f"terrain.file={self.file} has nothing below terrain.ceiling={self.ceiling}")
        heights[empty] = heights[~empty].min() if self.outside is None else self.outside
        return heights, (float(low[0]), float(low[1]))

    def floor(self, heights: np.ndarray) -> np.ndarray:
        return heights < (math.inf if self.ceiling is None else self.ceiling)  # not where walls are cut

    def _check_upright(self, corners: np.ndarray) -> None:
        """Refuses a mesh (T, 3, 3) m, z up, that is higher than deep and has more of its area upright than level."""
        width, depth, height = np.ptp(corners, (0, 1))
        area = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).sum(0)
        if height > depth and area[1] > area[2]:
            taken = up_of(self.file)
            other = "y" if taken == "z" else "z"
            raise ValueError(
                f"terrain.file={self.file} would be {width:.1f} x {depth:.1f} m and {height:.1f} m high with its"
                f" {taken} up, and more of its surfaces would be walls than ground; give terrain.up={other} or,"
                f" if that is meant, terrain.up={taken}"
            )


def _first_of(heights: np.ndarray, cell: float) -> tuple[float, float]:
    """Where (m) the first point of a map is that has (0, 0) in its middle."""
    rows, cols = heights.shape
    return -(cols - 1) * cell / 2, -(rows - 1) * cell / 2


def read_image(file: str) -> np.ndarray:
    """(rows, cols) float64 brightness, 0 black to 1 white, of a picture; the first row is its lowest.

    What is transparent is white, as it is seen on paper.

    Raises:
        ValueError: it is no picture.
    """
    try:
        with Image.open(file) as image:
            deep = image.mode.startswith("I")  # 16 bit
            grey = image if deep else _on_white(image).convert("L")
            values = np.asarray(grey, dtype=np.float64)
            if deep and isinstance(image.info.get("transparency"), int):
                values = np.where(values == image.info["transparency"], 65535.0, values)
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"terrain.file={file} is no picture that can be read ({str(error).splitlines()[0]})") from None
    return values[::-1] / (65535.0 if deep else 255.0)


def _on_white(image: Image.Image) -> Image.Image:
    if not image.has_transparency_data:
        return image
    return Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA"))


def read_array(file: str) -> np.ndarray:
    """(rows, cols) float64 heights (m) of a NumPy file; a ValueError of one line if it holds something else."""
    try:
        heights = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ValueError(f"terrain.file={file} is no NumPy array ({str(error).splitlines()[0]})") from None
    if not isinstance(heights, np.ndarray) or heights.ndim != 2 or heights.dtype.kind not in "fiu":
        shape = getattr(heights, "shape", "several arrays")
        raise ValueError(f"terrain.file={file} holds {shape}; (rows, cols) heights in m were expected")
    return heights.astype(np.float64)


def seen_from_above(
    corners: np.ndarray, x: np.ndarray, y: np.ndarray, ceiling: float | None
) -> tuple[np.ndarray, bool]:
    """Heights (R, C) of the highest surface of a mesh above points x (C,), y (R,), evenly spaced; -inf above nothing.

    And whether most of these surfaces face down, as they do where a mesh is wound inside out.

    With a ceiling, surfaces above it do not count. Where an odd number of them is above a point and the lowest of them
    faces up, the point is within a solid that goes through the ceiling: there the height is the ceiling's. (A single
    surface that faces down is a room's own ceiling.)

    Args:
        corners: (T, 3, 3) m, of triangles.
        x, y: m.
        ceiling: m, or None.
    """
    heights, within = np.full((len(y), len(x)), -np.inf), np.zeros((len(y), len(x)), bool)
    lowest, faces_up = np.full_like(heights, np.inf), np.zeros_like(within)
    upside_down = np.zeros_like(within)
    spacing = x[1] - x[0], y[1] - y[0]
    x, y = (at + share * step for at, share, step in zip((x, y), _OFF_LINE, spacing, strict=True))
    low, high = corners.min(1), corners.max(1)
    first = np.stack([np.searchsorted(at, low[:, k], "left") for k, at in ((0, x), (1, y))], 1)
    last = np.stack([np.searchsorted(at, high[:, k], "right") for k, at in ((0, x), (1, y))], 1)
    a, b, c = (corners[:, k] for k in range(3))
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    for k in np.flatnonzero((area != 0.0) & (last > first).all(1)):  # the others are upright or between points
        window = slice(first[k, 1], last[k, 1]), slice(first[k, 0], last[k, 0])
        dx, dy = x[window[1]][None] - a[k, 0], y[window[0]][:, None] - a[k, 1]
        u = (dx * ac[k, 1] - dy * ac[k, 0]) / area[k]
        v = (dy * ab[k, 0] - dx * ab[k, 1]) / area[k]
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        z = a[k, 2] + u * ab[k, 2] + v * ac[k, 2]
        above = inside & (z > ceiling) if ceiling is not None else np.zeros_like(inside)
        highest = inside & ~above & (z > heights[window])
        upside_down[window] = np.where(highest, area[k] < 0.0, upside_down[window])
        heights[window] = np.where(highest, z, heights[window])
        within[window] ^= above
        faces_up[window] = np.where(above & (z < lowest[window]), area[k] > 0.0, faces_up[window])
        lowest[window] = np.where(above, np.minimum(lowest[window], z), lowest[window])
    solid = within & faces_up
    ground = ~solid & np.isfinite(heights)
    heights = heights if ceiling is None else np.where(solid, ceiling, heights)
    return heights, bool(upside_down[ground].sum() * 2 > ground.sum())


def free_places(
    heights: np.ndarray,
    cell: float,
    config: StartsConfig,
    near: tuple[int, ...] | None = None,
    floor: np.ndarray | None = None,
) -> np.ndarray:
    """(n, 2) int64 grid points (column, row) that are free by `config`, in random order; see `StartsConfig`.

    Args:
        heights: (rows, cols) m.
        cell: m.
        config: what is free.
        near: a grid point (column, row) on the ground that is meant; None: that of the largest area.
        floor: (rows, cols) bool, which points may belong to it; None: all.
    """
    region = connected(heights, config.climb)
    region = region if floor is None else np.where(floor, region, region.size)
    area = np.bincount(region.ravel(), minlength=region.size)[: region.size]
    chosen = region[near[1], near[0]] if near is not None else area.argmax()
    reach, margin = round(config.radius / cell), round((EDGE + config.radius) / cell)
    level = _around(heights, reach, np.maximum) - _around(heights, reach, np.minimum) <= config.step
    free = level & _around((region == chosen) & (region < region.size), reach, np.logical_and)
    inner = np.zeros_like(free)
    inner[margin:-margin, margin:-margin] = True
    rows, cols = np.nonzero(free & inner)
    found = np.stack((cols, rows), -1).astype(np.int64)
    return np.random.default_rng(config.seed).permutation(found)[: config.num]


def connected(heights: np.ndarray, climb: float) -> np.ndarray:
    """(rows, cols) int64 number of the ground that each point belongs to: one can walk between points of the same
    number from neighbour to neighbour, whose heights differ by at most `climb`."""
    begins = np.ones(heights.shape, bool)  # runs along rows, which hang together
    begins[:, 1:] = ~(np.abs(np.diff(heights, axis=1)) <= climb)
    run = np.cumsum(begins).reshape(heights.shape) - 1
    up = np.abs(np.diff(heights, axis=0)) <= climb
    return np.flatnonzero(begins)[_least_linked(int(run[-1, -1]) + 1, run[:-1][up], run[1:][up])][run]


def _least_linked(num: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(num,) int64: the least of the numbers 0 to num - 1 that each hangs together with by (L,) links of two."""
    least = np.arange(num)
    while len(one):
        np.minimum.at(least, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(further := least[least], least):
            least = further
        one, other = least[one], least[other]
        apart = one != other
        one, other = one[apart], other[apart]
    return least


def _around(values: np.ndarray, reach: int, combine: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """`combine` of all values within a square of `reach` grid points to each side, as far as there are any."""
    for axis in (0, 1):
        turned = np.moveaxis(values, axis, 0)
        padded = np.concatenate((turned[:1].repeat(reach, 0), turned, turned[-1:].repeat(reach, 0)))
        made = padded[: len(turned)]
        for shift in range(1, 2 * reach + 1):
            made = combine(made, padded[shift : shift + len(turned)])
        values = np.moveaxis(made, 0, axis)
    return values
