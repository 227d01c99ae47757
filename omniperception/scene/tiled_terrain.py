"""Terrain of square tiles as one height field: levels of growing difficulty along x, kinds along y."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import mujoco
import numpy as np
from pydantic import SkipValidation

from omniperception.common.checked import AsTuple, AtLeastOne, Cell, Count, InOrder, NonNegative, Share, checked
from omniperception.scene.height_field import add_height_field
from omniperception.scene.tiles import Tile, TileGrid


@checked("terrain.curriculum")
class TerrainCurriculumConfig:
    """When an environment moves to a harder or an easier tile, judged at the end of every episode.

    Up: it got farther from its start than half a tile, or it left the platform and walked at least `up_share` of what
    was commanded. Otherwise down: it walked less than `down_share` of that. Walked is the way along the commanded
    direction; in an episode that ended early, what was commanded counts as if it had gone on to the time limit.
    Beyond the hardest level any level is drawn.

    Attributes:
        start_level: environments begin on any level up to this one.
        up_share: see above.
        down_share: see above.
    """

    start_level: Count = 0
    up_share: float = 0.8
    down_share: NonNegative = 0.5

    def __post_init__(self) -> None:
        if self.down_share > self.up_share:
            raise ValueError(
                f"terrain.curriculum.down_share={self.down_share} must lie between 0 and up_share={self.up_share}"
            )


_Difficulty = Annotated[tuple[Share, Share], AsTuple, InOrder, "[low, high] with 0 <= low <= high <= 1"]


@checked("terrain")
class TiledTerrainConfig:
    """Square tiles in rows of equal difficulty and columns of one kind, with a flat border around them.

    An environment keeps its column and has a level that may change at its resets. It starts in the middle of its tile,
    which is the origin of its frame, and may walk on to the tiles beside. At a metre from the border's outer edge its
    episode ends as a time-out.

    Attributes:
        tiles: kinds of tiles by name.
        levels: number of rows; their difficulty rises evenly through `difficulty`.
        columns: number of columns; the kinds have as many as their shares say, at least one each.
        tile_size: side of a tile (m).
        platform: side of the flat square in its middle (m).
        cell: side of a cell of the height field (m).
        border: width (m) of the flat border.
        seed: of the tiles' random parts.
        difficulty: of the lowest and of the highest level, 0 to 1.
        curriculum: None: every episode starts on any level.
        friction: sliding friction coefficient of the ground; it holds for every contact with the ground.
        restitution: the ground's coefficient of restitution in [0, 1]; a contact has half of it, see `ground_solrefs`.
    """

    tiles: Mapping[str, SkipValidation[Tile]]
    levels: AtLeastOne = 10
    columns: AtLeastOne = 10
    tile_size: float = 8.0
    platform: float = 2.0
    cell: Cell = 0.1
    border: float = 10.0
    seed: Count = 0
    difficulty: _Difficulty = (0.0, 1.0)
    curriculum: TerrainCurriculumConfig | None = None
    friction: NonNegative = 0.8
    restitution: Share = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "tiles", {name: tile for name, tile in self.tiles.items() if tile is not None})
        if not self.tiles:
            raise ValueError("terrain.tiles is empty; name a kind of tile, or use terrain=flat")
        if abs(self.tile_size / self.cell / 2 - self.grid.half) > 1e-6 or self.grid.half < 2:
            raise ValueError(f"terrain.tile_size={self.tile_size} must be an even number of cells of {self.cell} m")
        if not (self.platform >= 1.0 and self.grid.platform < self.grid.half):
            raise ValueError(
                f"terrain.platform={self.platform} must be at least 1, where a robot fits, and smaller than the tile by"
                f" two cells of {self.cell} m"
            )
        if self.border < 2.0:
            raise ValueError(f"terrain.border={self.border} must be at least 2: an episode ends 1 m before its edge")
        if self.curriculum is not None and self.curriculum.start_level >= self.levels:
            raise ValueError(
                f"terrain.curriculum.start_level={self.curriculum.start_level} must be below"
                f" terrain.levels={self.levels}"
            )
        idle = sorted(set(self.tiles) - set(self.column_kinds()))
        if idle:
            raise ValueError(
                f"terrain.columns={self.columns} leaves none to {', '.join(idle)}; use more columns or larger shares"
            )

    @property
    def grid(self) -> TileGrid:
        """The points of one tile."""
        half = round(self.tile_size / self.cell / 2)
        return TileGrid(half, round(self.platform / self.cell / 2), self.cell)

    @property
    def border_cells(self) -> int:
        return round(self.border / self.cell)

    def column_kinds(self) -> tuple[str, ...]:
        """Name of the kind of tile in each column."""
        names, shares = list(self.tiles), np.array([tile.share for tile in self.tiles.values()])
        middles = (np.arange(self.columns) + 0.5) / self.columns
        chosen = np.searchsorted(np.cumsum(shares) / shares.sum(), middles)
        return tuple(names[min(k, len(names) - 1)] for k in chosen)

    def level_difficulty(self, level: int) -> float:
        low, high = self.difficulty
        return low + (high - low) * level / max(self.levels - 1, 1)

    def height_map(self) -> np.ndarray:
        """(rows, cols) float64 heights (m), x along columns, y along rows; the border and the tiles' edges are at 0."""
        grid, border, side = self.grid, self.border_cells, 2 * self.grid.half
        heights = np.zeros((self.columns * side + 2 * border + 1, self.levels * side + 2 * border + 1))
        seeds = np.random.SeedSequence(self.seed).spawn(self.columns * self.levels)
        for column, kind in enumerate(self.column_kinds()):
            for level in range(self.levels):
                rng = np.random.default_rng(seeds[column * self.levels + level])
                row, col = border + column * side, border + level * side
                tile = self.tiles[kind].heights(grid, self.level_difficulty(level), rng)
                heights[row : row + side + 1, col : col + side + 1] += tile
        return heights

    def starts(self) -> np.ndarray:
        """(columns, levels, 2) int64 grid points (column, row) in the middles of the tiles, which are origins."""
        tile = np.stack(np.meshgrid(np.arange(self.levels), np.arange(self.columns)), -1)
        return self.border_cells + (2 * tile + 1) * self.grid.half

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the height field on a kinematic body, so that every environment can have its own tile at its origin."""
        add_height_field(spec, self.height_map(), self.cell, self.friction, self.restitution)
