"""What is shown, and where the page listens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from omnirobot.common.cli import argument
from omnirobot.common.errors import UserError

if TYPE_CHECKING:
    from omnilidar import RayScene
    from omniperception.scene import RobotConfig

LOCALHOST = "127.0.0.1"
PORT = 8080


class ViewerError(UserError, RuntimeError):
    """The page cannot be opened; one line says why and what to do."""


SWITCHED = ("scenario", "condition", "terrain", "obstacles", "lidar", "robot")
"""Groups of presets that are switched on the page; a scenario brings its own terrain and obstacles."""


@dataclass(frozen=True)
class PageArguments:
    """Arguments of commands that mean something with viewer=web alone."""

    host: str = argument(
        LOCALHOST, "address at which viewer=web listens; the default is reached from this machine alone"
    )
    port: int = argument(PORT, "port at which viewer=web listens", least=1)

    @property
    def page(self) -> PageOptions:
        """The same, checked."""
        return PageOptions(host=self.host, port=self.port)


PAGE = tuple(field.name for field in fields(PageArguments))
"""Their names."""


@dataclass(frozen=True)
class PageOptions(PageArguments):
    """Where the page listens, and until when.

    Attributes:
        stop_after_s: s of wall time after which the viewer ends by itself; None: never.
        open_browser: whether the page is opened in this machine's browser.
    """

    stop_after_s: float | None = None
    open_browser: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise ViewerError(f"port={self.port} must lie in 1 to 65535")
        if self.stop_after_s is not None and self.stop_after_s <= 0:
            raise ViewerError(f"stop_after_s={self.stop_after_s} must be positive")

    @property
    def is_local(self) -> bool:
        """Tell whether only this machine reaches the page."""
        return self.host in (LOCALHOST, "localhost", "::1")


@dataclass(frozen=True)
class Shown:
    """A run and the task that it is shown in.

    Attributes:
        run_dir: run directory.
        overrides: changes to its configuration, presets and values.
        policy: "run" or a name of `evaluation.trials.policies.BASELINES`.
        checkpoint: file of weights; None: the run's newest.
        trust: packages of one's own that the configuration may name.
    """

    run_dir: Path
    overrides: tuple[str, ...] = ()
    policy: str = "run"
    checkpoint: Path | None = None
    trust: tuple[str, ...] = ()


@dataclass(frozen=True)
class Room:
    """Where sensors are looked at: a ray scene of one environment with a robot and people who walk about.

    Attributes:
        scene: the shapes.
        robot: that carries the sensor.
        bodies: index of each of its links in the scene, by name.
        robot_geoms: index of each of its shapes, by the name of its geom.
        movers: bodies that walk about.
        extent: (low, high) along x and y (m) in which they do.
        open_side: shapes that are not drawn, so that one can look in.
        colours: of each class, "#rrggbb".
        reflectivity: of each class, 0 to 1.
        names: of the classes.
    """

    scene: RayScene
    robot: RobotConfig
    bodies: Mapping[str, int]
    robot_geoms: Mapping[str, int]
    movers: tuple[int, ...]
    extent: tuple[tuple[float, float], tuple[float, float]]
    open_side: tuple[int, ...]
    colours: Mapping[int, str]
    reflectivity: Mapping[int, float]
    names: Mapping[int, str]
