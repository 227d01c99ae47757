"""The viewer: one thread steps the task in real time and draws, the page's threads only ask it to do things."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from omniperception import config
from omniperception.config import ConfigError
from omniperception.evaluation.film.perceived import true
from omniperception.learning import CheckpointError, latest_checkpoint
from omniperception.viewer.drive import Stick, Velocity
from omniperception.viewer.options import SWITCHED, PageOptions, Shown
from omniperception.viewer.page import Page, check_free
from omniperception.viewer.panels import PUSH_SPEED, Callbacks, Panels
from omniperception.viewer.session import Session
from omniperception.viewer.stage import STICK_REACH, Stage, turned

CHART_HZ = 5.0
LOOK_S = 2.0
"""How often (s) a followed run is asked for a newer checkpoint."""
LISTS_S = 10.0
"""How often (s) runs and checkpoints are looked for."""
PUSH_AHEAD_M = 1.5
"""Where (m) before the robot a spare obstacle is put."""
WRONG = (ConfigError, CheckpointError, ValueError, ImportError)
"""What a person can ask for in vain: one line on the page, and what was there goes on."""


class Viewer(Page):
    """A run in the browser.

    Attributes:
        session: the run and its task.
        stage, panels: the scene and the controls of the page.
        paused: whether time stands.
        stick: what a person commands.
        push_speed: m/s by which a push changes the robot's velocity.
        follows: whether the newest checkpoint of the run is loaded as it appears.
    """

    refused = WRONG

    def __init__(self, shown: Shown, options: PageOptions) -> None:
        """Builds the task, then opens the page; a port that is taken is told at once.

        Raises:
            ViewerError: the page cannot be opened.
            ConfigError, CheckpointError: the run cannot be shown.
        """
        self._threads = torch.get_num_threads()
        chosen, rest = _split(shown.overrides)
        self._choices, self._rest = chosen, rest
        check_free(options)
        self.session = Session(replace(shown, overrides=self._overrides()))
        super().__init__(options, "OmniPerception", self.session.env.control_dt)
        self.paused, self._single = False, 0
        self.stick, self.push_speed, self.follows = Stick(), PUSH_SPEED, False
        self._charts_due = self._look_due = self._lists_due = 0.0
        self._frames_drawn, self._shown_points = 0, 0
        self._redraw = True
        self.stage = Stage(self.server, self.session)
        self.stage.on_drag = self._obstacle_dragged
        self.stage.on_take_away = self._obstacle_taken
        self.stage.on_push = lambda direction: self.ask(lambda: self.push(direction))
        self.stage.on_stick = lambda xy: self.ask(lambda: self._stick_dragged(xy))
        self.panels = Panels(self, self._callbacks(), self.stage, self.session, self._presets())
        self.panels.show_choices(self.choices, self.session)
        self.server.on_client_connect(lambda client: self.ask(self._draw_again))

    def _callbacks(self) -> Callbacks:
        return Callbacks(
            drive=self.drive,
            nudge=self.nudge,
            pause=self.pause,
            set_speed=self.set_speed,
            single_step=self.single_step,
            new_trial=self.new_trial,
            set_push_speed=partial(setattr, self, "push_speed"),
            push_aside=self.push_aside,
            bring=self.bring,
            look_at_robot=self.look_at_robot,
            choose_run=self.choose_run,
            choose_checkpoint=self.choose_checkpoint,
            follow=partial(setattr, self, "follows"),
            choose_policy=self.choose_policy,
            choose_preset=self.choose,
        )

    # ---- the loop ----------------------------------------------------------------------------------------------------

    def run(self) -> None:
        torch.set_num_threads(1)  # tensors of one environment
        try:
            super().run()
        finally:
            torch.set_num_threads(self._threads)

    def advance(self) -> float:
        self._redraw |= self.serve_requests()
        if self.paused and not self._single:
            self._draw_if_due(paused=True)
            return 0.02
        self._single = max(self._single - 1, 0)
        self.session.step()
        wait = self.clock.stepped()
        self._draw_if_due()
        self._look_for_weights()
        return wait

    # ---- drawing -----------------------------------------------------------------------------------------------------

    def _draw_if_due(self, paused: bool = False) -> None:
        if not self.server.get_clients():
            return
        now = time.monotonic()
        redraw, self._redraw = self._redraw, False  # what is asked for from here on is drawn the next time
        due = not paused and self.clock.picture_is_due()
        if due or redraw:
            perceived, there = self.session.perceived(), true(self.session.env)
            self.stage.draw(perceived, there, self.session.driven is not None)
            if self.session.frames != self._frames_drawn or redraw:
                self._frames_drawn, self._shown_points = self.session.frames, self.stage.draw_points()
                self.clock.clouds += 1
            if now >= self._charts_due or redraw:
                self._charts_due = now + 1.0 / CHART_HZ
                self.panels.draw_charts(perceived, there)
        if now >= self._lists_due:
            self._lists_due = now + LISTS_S
            self.panels.renew_lists()
        if self.status_is_due():
            self.panels.draw_status(self._shown_points)

    def _draw_again(self) -> None:
        """Draws everything for somebody who has just come."""
        self._redraw, self._frames_drawn = True, -1

    # ---- driving -----------------------------------------------------------------------------------------------------

    def drive(self, velocity: Velocity | None) -> None:
        """Commands a velocity; None gives the task its commands back."""
        self.session.drive(None if velocity is None else self.stick.set(velocity))
        self.panels.show_drive(self.session.driven)

    def nudge(self, ahead: float = 0.0, aside: float = 0.0, turn: float = 0.0) -> None:
        """Changes the command by a step."""
        if self.session.driven is None:
            self.stick.set((0.0, 0.0, 0.0))
        self.drive(self.stick.moved(ahead, aside, turn))

    def push(self, direction: tuple[float, float]) -> None:
        """Pushes the robot along (x, y), environment frame."""
        self.session.push((self.push_speed * direction[0], self.push_speed * direction[1]))

    def push_aside(self) -> None:
        """Pushes the robot to its left."""
        yaw = float(self.session.env.state.kinematics.yaw[0])
        self.push((-math.sin(yaw), math.cos(yaw)))

    def _stick_dragged(self, xy: tuple[float, float]) -> None:
        kinematics = self.session.env.state.kinematics
        offset = kinematics.base_pos_w.new_tensor(xy) - kinematics.base_pos_w[0, :2]
        ahead, aside = turned(offset.numpy(force=True), -float(kinematics.yaw[0])) / STICK_REACH
        turn = self.stick.value[2] if self.session.driven is not None else 0.0
        self.drive((float(ahead), float(aside), turn))

    # ---- time --------------------------------------------------------------------------------------------------------

    def pause(self, paused: bool) -> None:
        """Lets time stand or run."""
        self.paused = paused
        self.clock.start()
        self.panels.show_pause(paused)

    def single_step(self) -> None:
        """Pauses and does one control step."""
        self.pause(True)
        self._single += 1
        self._redraw = True

    def set_speed(self, speed: float) -> None:
        """Simulated seconds per second."""
        self.clock.speed = speed
        self.clock.start()

    def look_at_robot(self) -> None:
        """Has everybody look at the robot as at the beginning, wherever it is and the mouse has turned their view."""
        self.stage.look(self.server.get_clients().values())

    def new_trial(self) -> None:
        """Ends the trial; the next one is another scene."""
        self.session.reset()

    # ---- obstacles ---------------------------------------------------------------------------------------------------

    def bring(self, kind: str) -> None:
        """Puts a spare obstacle before the robot, in the direction that it faces."""
        state = self.session.env.state.kinematics
        yaw = float(state.yaw[0])
        x, y = state.base_pos_w[0, :2].tolist()
        number = self.session.bring(kind, (x + PUSH_AHEAD_M * math.cos(yaw), y + PUSH_AHEAD_M * math.sin(yaw)))
        self.say(f"{kind} (obstacle {number}) stands {PUSH_AHEAD_M:g} m ahead; drag it, shift-click takes it away")

    def _obstacle_dragged(self, part: int, phase: str, xy: tuple[float, float]) -> None:
        def request(session: Session) -> None:
            obstacle = session.obstacle_of(part)
            if phase == "end":
                session.let_go(obstacle)
            else:
                session.hold(obstacle, xy)

        self._ask_of_session(request)

    def _obstacle_taken(self, part: int) -> None:
        self._ask_of_session(lambda session: session.take_away(session.obstacle_of(part)))

    def _ask_of_session(self, request: Callable[[Session], None]) -> None:
        """As `ask`, unless another task is shown by then: its parts are others."""
        session = self.session
        self.ask(lambda: request(session) if session is self.session else None)

    # ---- switching ---------------------------------------------------------------------------------------------------

    def choose(self, group: str, preset: str | None) -> None:
        """Switches a preset of SWITCHED, or gives the run its own back; rebuilds the task."""
        choices = {**self._choices, group: preset}
        if group == "scenario" and preset is not None:
            choices |= {"terrain": None, "obstacles": None}
        self._switch(choices, self.session.shown)

    def choose_policy(self, name: str) -> None:
        """Switches who acts."""
        self._switch(self._choices, replace(self.session.shown, policy=name))

    def choose_run(self, run_dir: Path) -> None:
        """Switches to another run, with the presets that are chosen."""
        self._switch(self._choices, replace(self.session.shown, run_dir=run_dir, checkpoint=None))

    def choose_checkpoint(self, path: Path) -> None:
        """Puts other weights into the network while the robot walks on."""
        self.session.load(path)
        self.session.shown = replace(self.session.shown, checkpoint=None if self.follows else path)
        self.say(f"{path} walks now")
        self.panels.show_checkpoint(path)

    def _switch(self, choices: dict[str, str | None], shown: Shown) -> None:
        before, self._choices = self._choices, choices
        self.say("building ...")
        self.panels.draw_status(self._shown_points)
        try:
            session = Session(replace(shown, overrides=self._overrides()))
        except WRONG:
            self._choices = before
            self.panels.show_choices(before, self.session)
            raise
        driven = self.session.driven
        self.session = session
        self.session.drive(driven)
        if self.panels.num_rays is not None:
            session.show_cloud(self.panels.num_rays)
        self.stage.show(session)
        self.panels.show_choices(choices, session)
        self.clock.dt = session.env.control_dt
        self.clock.start()
        self._draw_again()
        actor = session.checkpoint if shown.policy == "run" else f"policy={shown.policy}"
        self.say(f"{actor} in {self._where()}")

    def _overrides(self) -> tuple[str, ...]:
        chosen = tuple(f"{group}={preset}" for group, preset in self._choices.items() if preset is not None)
        threads = () if any(o.startswith("sim.num_threads=") for o in self._rest) else ("sim.num_threads=1",)
        return (*self._rest, *chosen, *threads)

    def _where(self) -> str:
        chosen = [f"{group}={preset}" for group, preset in self._choices.items() if preset is not None]
        return ", ".join(chosen) or "the task that it was trained in"

    @property
    def choices(self) -> dict[str, str | None]:
        """Presets that are chosen, by group; None: the run's own."""
        return {group: self._choices.get(group) for group in SWITCHED}

    def _presets(self) -> dict[str, tuple[str, ...]]:
        """Presets by group, those in the run's own folders and in --config-dir included."""
        path = config.search_path(self._rest, config.read(self.session.shown.run_dir))
        return {group: config.presets(group, path) for group in SWITCHED}

    def _look_for_weights(self) -> None:
        now = time.monotonic()
        if not self.follows or now < self._look_due:
            return
        self._look_due = now + LOOK_S
        try:
            newest = latest_checkpoint(self.session.shown.run_dir)
            if newest != self.session.checkpoint:
                self.choose_checkpoint(newest)
        except WRONG as error:
            self.follows = False
            self.say(f"refused: {' '.join(str(error).split())}; following ends")
            self.panels.show_follow(False)


def _split(overrides: tuple[str, ...]) -> tuple[dict[str, str | None], tuple[str, ...]]:
    """Presets that the page switches, by group, and the other overrides."""
    chosen: dict[str, str | None] = {}
    rest = []
    for override in overrides:
        group, _, preset = override.partition("=")
        if group in SWITCHED:
            chosen[group] = None if preset in ("null", "") else preset
        else:
            rest.append(override)
    return chosen, tuple(rest)
