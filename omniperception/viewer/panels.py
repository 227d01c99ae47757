"""The controls of the page, and what stands beside the scene: status, charts, messages."""

from __future__ import annotations

import contextlib
import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from omniperception.config import OUTPUTS, SHIPPED_RUNS, find_runs
from omniperception.evaluation.film.perceived import Perceived
from omniperception.evaluation.trials.policies import BASELINES
from omniperception.learning.checkpoint import list_checkpoints
from omniperception.viewer import charts
from omniperception.viewer.colours import ARROWS, CLASSES, DISTAL, PROXIMAL
from omniperception.viewer.drive import MAX_SPEED, MAX_YAW_RATE, Velocity
from omniperception.viewer.page import Page
from omniperception.viewer.session import MOST_POINTS, Session, spare_kinds
from omniperception.viewer.stage import POINT_COLOURS, Stage

OWN = "(the run's own)"
STEP, TURN = 0.2, 0.25
"""By how much (m/s, rad/s) a key changes the command."""
SPEEDS = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/10": 0.1}
PUSH_SPEED = 0.8
"""m/s by which a push changes the robot's velocity at first."""
SHOWN = ("robot", "obstacles", "points", "sectors", "arrows", "heights")
SMOOTHING = 0.2
"""Share of the newest value in the bars of rewards."""
KEYS = (
    "**I K** ahead, back · **J L** left, right · **U O** turn · **X** stand · **T** the task commands ·"
    " **Space** pause · **N** one step · **R** new trial · **P** push · **B** bring the obstacle ·"
    " **V** look at the robot"
)


@dataclass(frozen=True)
class Callbacks:
    """What becomes of a person's use of the controls; called between two steps."""

    drive: Callable[[Velocity | None], None]
    nudge: Callable[..., None]
    pause: Callable[[bool], None]
    set_speed: Callable[[float], None]
    single_step: Callable[[], None]
    new_trial: Callable[[], None]
    set_push_speed: Callable[[float], None]
    push_aside: Callable[[], None]
    bring: Callable[[str], None]
    look_at_robot: Callable[[], None]
    choose_run: Callable[[Path], None]
    choose_checkpoint: Callable[[Path], None]
    follow: Callable[[bool], None]
    choose_policy: Callable[[str], None]
    choose_preset: Callable[[str, str | None], None]


class Panels:
    """Controls of the page.

    Attributes:
        num_rays: rays shown of a frame; None: those of the policy.
    """

    def __init__(
        self, page: Page, act: Callbacks, stage: Stage, session: Session, presets: Mapping[str, tuple[str, ...]]
    ) -> None:
        """`presets` by group; `show_choices` has to follow."""
        self._page, self._act, self._stage, self._session = page, act, stage, session
        self._gui = page.server.gui
        self.num_rays: int | None = None
        self._rewards: dict[str, float] = {}
        self._status = self._gui.add_html("")
        with self._gui.add_folder("Risk of velocities, ahead is up"):
            self._polar = self._gui.add_html("")
            self._gui.add_html(charts.legend(ARROWS))
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Drive"):
            self._build_drive()
        with tabs.add_tab("Task"):
            self._build_task(presets)
        with tabs.add_tab("View"):
            self._build_view()
        with tabs.add_tab("Rewards"):
            self._bars = self._gui.add_html("")
        self._build_keys()

    # ---- building ----------------------------------------------------------------------------------------------------

    def _build_drive(self) -> None:
        gui, act = self._gui, self._act
        self._driven = gui.add_checkbox("I command", False, hint="or else the task does")
        self._sliders = [
            gui.add_slider(name, min=-most, max=most, step=0.05, initial_value=0.0)
            for name, most in (
                ("ahead (m/s)", MAX_SPEED),
                ("left (m/s)", MAX_SPEED),
                ("turn left (rad/s)", MAX_YAW_RATE),
            )
        ]
        self._page.on_change(self._driven, lambda on: act.drive(self._stick() if on else None))
        for slider in self._sliders:
            self._page.on_change(slider, lambda _: act.drive(self._stick()))
        gui.add_markdown(KEYS)
        with gui.add_folder("Time"):
            self._pause = gui.add_checkbox("pause", False)
            self._page.on_change(self._pause, act.pause)
            speed = gui.add_button_group("speed", tuple(SPEEDS))
            self._page.on_click(speed, lambda: act.set_speed(SPEEDS[speed.value]))
            self._page.on_click(gui.add_button("one step (N)"), act.single_step)
            self._page.on_click(gui.add_button("new trial (R)"), act.new_trial)
        with gui.add_folder("Disturb"):
            push = gui.add_slider("push by (m/s)", min=0.1, max=3.0, step=0.1, initial_value=PUSH_SPEED)
            self._page.on_change(push, act.set_push_speed)
            self._page.on_click(gui.add_button("push to its left (P)"), act.push_aside)
            self._kind = gui.add_dropdown("obstacle", spare_kinds(self._session.env))
            self._page.on_click(gui.add_button("bring it (B)"), lambda: act.bring(self._kind.value))
            gui.add_markdown("Drag obstacles with the mouse; shift-click takes one away; click on the robot pushes it.")

    def _build_task(self, presets: Mapping[str, tuple[str, ...]]) -> None:
        gui, act, on_change = self._gui, self._act, self._page.on_change
        self._run = gui.add_dropdown("run", _runs(self._session.shown.run_dir))
        on_change(self._run, lambda name: act.choose_run(Path(name)))
        self._checkpoint = gui.add_dropdown("checkpoint", self._checkpoint_names())
        on_change(self._checkpoint, self._choose_checkpoint)
        self._weights = gui.add_text("weights file", "", hint="any checkpoint of this network")
        load = gui.add_button("load weights file")
        self._page.on_click(load, lambda: act.choose_checkpoint(Path(self._weights.value)))
        self._follow = gui.add_checkbox("follow the newest checkpoint", False, hint="of a training that goes on")
        on_change(self._follow, act.follow)
        self._policy = gui.add_dropdown("policy", ("run", *BASELINES))
        on_change(self._policy, act.choose_policy)
        self._presets = {group: gui.add_dropdown(group, (OWN, *names)) for group, names in presets.items()}
        for group, dropdown in self._presets.items():
            on_change(dropdown, partial(self._choose, group))

    def _build_view(self) -> None:
        gui, stage = self._gui, self._stage
        self._page.on_click(gui.add_button("look at the robot (V)"), self._act.look_at_robot)
        follow = gui.add_checkbox("keep the robot in the middle", stage.follows)
        self._page.on_change(follow, lambda on: setattr(stage, "follows", on))
        for name in SHOWN:
            box = gui.add_checkbox(name, name in stage.shows)
            self._page.on_change(box, partial(self._show, name))
        self._page.on_change(
            gui.add_checkbox("shadows", False, hint="for browsers with a graphics card"), stage.cast_shadows
        )
        colour = gui.add_dropdown("points coloured by", POINT_COLOURS, initial_value=stage.points_by)
        self._page.on_change(colour, self._colour_points)
        size = gui.add_slider("point size (m)", min=0.005, max=0.08, step=0.005, initial_value=stage.point_size)
        self._page.on_change(size, lambda value: setattr(stage, "point_size", value))
        rays = gui.add_dropdown("rays shown", ("those of the policy", "the whole sensor"))
        self._page.on_change(rays, self._choose_rays)
        self._legend = gui.add_html(_point_legend(stage.points_by))

    def _build_keys(self) -> None:
        act = self._act
        keys: dict[str, tuple[str, Callable[[], None]]] = {  # W A S D Q E and arrows are viser's: they move the view
            "I": ("faster ahead", lambda: act.nudge(ahead=STEP)),
            "K": ("slower, then back", lambda: act.nudge(ahead=-STEP)),
            "J": ("to the left", lambda: act.nudge(aside=STEP)),
            "L": ("to the right", lambda: act.nudge(aside=-STEP)),
            "U": ("turn left", lambda: act.nudge(turn=TURN)),
            "O": ("turn right", lambda: act.nudge(turn=-TURN)),
            "X": ("stand", lambda: act.drive((0.0, 0.0, 0.0))),
            "T": ("the task commands", lambda: act.drive(None)),
            "space": ("pause or go on", lambda: act.pause(not self._pause.value)),
            "N": ("one control step", act.single_step),
            "R": ("new trial", act.new_trial),
            "P": ("push the robot to its left", act.push_aside),
            "V": ("look at the robot", act.look_at_robot),
            "B": ("bring the obstacle", lambda: act.bring(self._kind.value)),
        }
        for key, (label, done) in keys.items():
            command = self._gui.add_command(label, hotkey=key)  # type: ignore[arg-type]  # viser's literals
            command.on_trigger(partial(self._pressed, done))

    def _pressed(self, act: Callable[[], None], event: Any) -> None:
        self._page.ask(act)

    def _stick(self) -> Velocity:
        ahead, aside, turn = (float(slider.value) for slider in self._sliders)
        return ahead, aside, turn

    def _choose(self, group: str, name: str) -> None:
        self._act.choose_preset(group, None if name == OWN else name)

    def _show(self, name: str, on: bool) -> None:
        (self._stage.shows.add if on else self._stage.shows.discard)(name)

    def _colour_points(self, name: str) -> None:
        self._stage.points_by = name
        self._legend.content = _point_legend(name)

    def _choose_rays(self, name: str) -> None:
        self.num_rays = MOST_POINTS if name == "the whole sensor" else None
        self._session.show_cloud(self.num_rays)

    def _choose_checkpoint(self, name: str) -> None:
        run_dir = self._session.shown.run_dir
        for path in list_checkpoints(run_dir):
            if path.name == name:
                return self._act.choose_checkpoint(path)
        raise ValueError(f"{name} is gone: {run_dir} keeps its newest checkpoints only")

    def _checkpoint_names(self) -> tuple[str, ...]:
        return tuple(path.name for path in list_checkpoints(self._session.shown.run_dir)[::-1]) or ("none",)

    # ---- showing what is the case ------------------------------------------------------------------------------------

    def show_drive(self, velocity: Velocity | None) -> None:
        """The stick as it is."""
        self._set(self._driven, velocity is not None)
        for slider, value in zip(self._sliders, velocity or self._stick(), strict=True):
            self._set(slider, value)

    def show_pause(self, paused: bool) -> None:
        """Whether time stands."""
        self._set(self._pause, paused)

    def show_follow(self, follows: bool) -> None:
        """Whether the newest checkpoint is loaded as it appears."""
        self._set(self._follow, follows)

    def show_checkpoint(self, path: Path) -> None:
        """Whose weights walk."""
        names = self._checkpoint_names()
        self._checkpoint.options = names
        if path.name in names and path.parent.parent == self._session.shown.run_dir:
            self._set(self._checkpoint, path.name)
        self._set(self._weights, str(path))

    def show_choices(self, choices: dict[str, str | None], session: Session) -> None:
        """The task as it is."""
        self._session = session
        for group, dropdown in self._presets.items():
            self._set(dropdown, choices.get(group) or OWN)
        self._set(self._policy, session.shown.policy)
        self._set(self._run, str(session.shown.run_dir))
        self.show_checkpoint(session.checkpoint)

    def renew_lists(self) -> None:
        """Runs and checkpoints that have come or gone meanwhile."""
        for handle, names in ((self._run, _runs(Path(self._run.value))), (self._checkpoint, self._checkpoint_names())):
            if tuple(handle.options) != tuple(names):
                chosen = handle.value
                handle.options = tuple(names)
                self._set(handle, chosen)

    def _set(self, handle: Any, value: object) -> None:
        with contextlib.suppress(ValueError):  # an option that is gone meanwhile
            if handle.value != value:
                handle.value = value

    def draw_status(self, points: int) -> None:
        """Who walks where, how fast time runs and what was left out."""
        session, clock, paused = self._session, self._page.clock, self._pause.value
        shown = "paused" if paused else f"real time x {clock.reached:.2f}"
        slow = not paused and 0.0 < clock.reached < 0.95 * clock.speed
        colour = "#c62f2f" if slow else "#2c7a3f"
        asked = "" if clock.speed == 1.0 else f" (asked for {clock.speed:g})"
        cloud = f"{points:,} points x {clock.clouds_hz:.0f}/s"
        rate = f"{clock.pictures_hz:.0f} pictures/s, {clock.dropped} dropped · {cloud}"
        ends: dict[str, int] = {}
        for outcome in session.outcomes:
            ends[outcome.cause] = ends.get(outcome.cause, 0) + 1
        touched = sum(outcome.touched for outcome in session.outcomes)
        trials = f"trial {len(session.outcomes) + 1}, {session.time_s:.1f} s"
        if ends:
            trials += " · ended: " + ", ".join(f"{n} {cause}" for cause, n in ends.items()) + f", {touched} touched"
        self._status.content = (
            f'<div style="padding:6px 12px;font-size:12px;line-height:1.5"><b style="color:{colour}">{shown}</b>{asked}'
            f" · {rate}<br>{html.escape(trials)}<br>{html.escape(_short(session.checkpoint))}"
            f"{_line(self._page.warning)}{_line(self._page.message)}</div>"
        )

    def draw_charts(self, perceived: Perceived | None, true: Perceived) -> None:
        """Risk of velocities and bars of reward terms."""
        session, env = self._session, self._session.env
        risk = env.config.rewards.avoidance.risk
        command = {"command": env.command.value[0, :2].tolist()}
        command["velocity"] = env.state.kinematics.base_lin_vel_yaw[0].tolist()[:2]
        drawings = []
        for name, seen in (("perceived", perceived), ("true", true)):
            if risk is not None and seen is not None and seen.risk is not None:
                arrows = dict(command)
                if seen.velocity is not None:
                    arrows[f"V_avoid {name}"] = seen.velocity.tolist()
                drawings.append(charts.risk_polar(name, seen.risk, risk, arrows))
        self._polar.content = charts.side_by_side(drawings) if drawings else _line("this task has no velocity risk")
        for term, value in session.rewards.items():
            self._rewards[term] = self._rewards.get(term, value) * (1 - SMOOTHING) + SMOOTHING * value
        self._rewards = {term: self._rewards[term] for term in session.rewards}
        bars = charts.reward_bars(self._rewards, sum(self._rewards.values())) if self._rewards else ""
        self._bars.content = charts.padded(bars) if bars else _line("this task has no rewards")


def _line(text: str) -> str:
    return f'<div style="font-size:12px"><i>{html.escape(text)}</i></div>' if text else ""


def _short(path: Path) -> str:
    """A path from the working directory, or its last parts."""
    path, here = path.resolve(), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(Path("...", *path.parts[-3:]))


def _point_legend(name: str) -> str:
    if name == "what it hit":
        return charts.legend({kind.name.lower(): rgb for kind, rgb in CLASSES.items()})  # type: ignore[attr-defined]
    if name == "proximal/distal":
        return charts.legend({"proximal": PROXIMAL, "distal": DISTAL})
    return charts.legend({f"blue to yellow: {name} from low to high": (60, 160, 120)})


def _runs(first: Path) -> list[str]:
    """Run directories that there are: the given one, those of outputs/, the newest first, and those of the package."""
    names: dict[Path, str] = {}
    for run in (first, *reversed(find_runs(OUTPUTS)), *find_runs(SHIPPED_RUNS)):
        names.setdefault(run.resolve(), str(run))
    return list(names.values())
