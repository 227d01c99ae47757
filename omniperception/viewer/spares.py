"""Obstacles that wait to be brought in by hand: a few of each kind that no episode has on its own."""

from __future__ import annotations

from dataclasses import replace

from omniperception.scene import ObstaclesConfig
from omniperception.scene.obstacle_group import ObstacleGroup
from omniperception.scene.parts import PartConfig, SwingConfig

PREFIX = "spare_"
EACH = 2
"""Of each kind: every one is a geom more in the physics, present or not. Some of them can move: in a scene in which
nothing does, nothing could be dragged."""

WALKING = {"walker": 0.8, "person": 0.8}
"""Speed (m/s) at which those set out that move."""


def _person() -> dict[str, PartConfig]:
    """A person of 1.7 m with legs that swing, as in conf/scenario/people.yaml."""

    def leg(side: float, phase: float) -> PartConfig:
        swing = SwingConfig(axis="y", amplitude_deg=25.0, per_metre=0.75, phase_deg=phase)
        return PartConfig("capsule", (0.07, 0.36), (0.0, side, 0.88), hang=0.43, swing=swing)

    return {
        "left_leg": leg(0.1, 0.0),
        "right_leg": leg(-0.1, 180.0),
        "trunk": PartConfig("capsule", (0.16, 0.16), (0.0, 0.0, 1.16)),
        "head": PartConfig("sphere", (0.11,), (0.0, 0.0, 1.59)),
    }


def spare_groups() -> dict[str, ObstacleGroup]:
    """Groups of which none takes part in an episode until it is put somewhere."""
    kinds: dict[str, dict] = {
        "box": {"kind": "box", "size": [(0.15, 0.4), (0.15, 0.4), (0.3, 0.6)]},
        "wall": {"kind": "box", "size": [(0.06, 0.06), (1.2, 1.2), (0.4, 0.4)]},
        "cylinder": {"kind": "cylinder", "size": [(0.2, 0.3), (0.6, 0.9)]},
        "pole": {"kind": "cylinder", "size": [(0.015, 0.015), (0.9, 0.9)]},
        "sphere": {"kind": "sphere", "size": [(0.12, 0.3)]},
        "capsule": {"kind": "capsule", "size": [(0.15, 0.25), (0.4, 0.6)]},
        "rock": {"kind": "mesh", "file": "rock", "size": [(0.3, 0.4), (0.25, 0.35), (0.2, 0.3)]},
        "bar": {"kind": "box", "size": [(0.04, 0.04), (0.5, 0.5), (0.04, 0.04)], "bottom": (0.3, 0.3)},
        "walker": {"kind": "cylinder", "size": [(0.2, 0.3), (0.75, 0.9)], "speed": (WALKING["walker"],) * 2},
        "person": {"kind": "compound", "parts": _person(), "speed": (WALKING["person"],) * 2},
    }
    return {PREFIX + name: ObstacleGroup(count=EACH, present=(0, 0), **what) for name, what in kinds.items()}


def with_spares(config: ObstaclesConfig) -> ObstaclesConfig:
    """The obstacles of a task and the spare ones."""
    return replace(config, groups={**config.groups, **spare_groups()})
