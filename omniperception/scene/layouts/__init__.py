"""Layouts: generators of whole worlds of boxes, as tables: corridors, mazes, clusters of blocks, cellular automata."""

from omniperception.scene.layouts.barn import BarnLayout
from omniperception.scene.layouts.base import Layout
from omniperception.scene.layouts.blocks import BlocksLayout
from omniperception.scene.layouts.corridor import CorridorLayout
from omniperception.scene.layouts.maze import MazeLayout

__all__ = ["BarnLayout", "BlocksLayout", "CorridorLayout", "Layout", "MazeLayout"]
