"""The page and its loop: where it listens, who can reach it, what it does between two steps."""

from __future__ import annotations

import errno
import logging
import math
import queue
import socket
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from omniperception.viewer.clock import Clock
from omniperception.viewer.options import LOCALHOST, PageOptions, ViewerError
from omnirobot.common.errors import ConfigError

if TYPE_CHECKING:
    import viser

PANEL_PIXELS = 440
PICTURE_HZ, STATUS_HZ = 25.0, 2.0


class Page:
    """A page whose loop does, between two steps, what other threads ask for.

    Attributes:
        server: the page's.
        clock: paces the steps.
        message: the newest line for whoever looks.
        refused: errors of a request that are told and do not end the loop.
    """

    refused: tuple[type[Exception], ...] = (ConfigError, ValueError, ImportError, OSError)

    def __init__(self, options: PageOptions, title: str, dt: float) -> None:
        """Opens the page of a simulation with steps of `dt` (s)."""
        self._options, self.server, self.message = options, open_page(options, title), ""
        self.clock = Clock(dt, PICTURE_HZ)
        self._requests: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stopped, self._status_due = False, 0.0

    def run(self) -> None:
        """Steps and draws until Ctrl-C, `stop`, or the time is up."""
        end = math.inf if self._options.stop_after_s is None else time.monotonic() + self._options.stop_after_s
        self.clock.start()
        try:
            while not self._stopped and time.monotonic() < end:
                wait = self.advance()
                if wait > 0:
                    time.sleep(wait)
        except KeyboardInterrupt:
            print("viewer: ended")

    def advance(self) -> float:
        """Serves requests, does one step and draws; returns for how long (s) to wait."""
        raise NotImplementedError

    def stop(self) -> None:
        """Ends `run`; from any thread."""
        self._stopped = True

    def close(self) -> None:
        """Takes the page down."""
        with _quiet():
            self.server.stop()

    def ask(self, request: Callable[[], None]) -> None:
        """Has something done between two steps; from any thread."""
        self._requests.put(request)

    def on_change(self, handle: Any, act: Callable[[Any], None]) -> None:
        """Has a change of a control by a person served between two steps; changes by the page itself are none."""

        def changed(event: Any) -> None:
            if event.client is not None:
                self.ask(partial(act, handle.value))

        handle.on_update(changed)

    def on_click(self, button: Any, act: Callable[[], None]) -> None:
        """Has a click on a button served between two steps."""
        button.on_click(lambda _: self.ask(act))

    def status_is_due(self) -> bool:
        """Tell whether to write the status now; always after a new message."""
        now = time.monotonic()
        if now < self._status_due or not self.server.get_clients():
            return False
        self._status_due = now + 1.0 / STATUS_HZ
        return True

    @property
    def warning(self) -> str:
        """Who can take hold, where it is not this machine alone."""
        return "" if self._options.is_local else "everybody who reaches this machine can take hold"

    def say(self, line: str) -> None:
        """Shows a line to whoever looks, on the page and in the terminal."""
        self.message, self._status_due = line, 0.0
        print(f"viewer: {line}", flush=True)

    def serve_requests(self) -> bool:
        """Does what was asked for; whether there was anything."""
        served = False
        while not self._requests.empty():
            served, request = True, self._requests.get()
            try:
                request()
            except self.refused as error:
                self.say(f"refused: {' '.join(str(error).split())}")
        return served


def add_points(scene: viser.SceneApi, name: str, size: float) -> viser.PointCloudHandle:
    """A cloud of points of `size` (m), empty but for one."""
    style: Any = {"point_shape": "circle", "precision": "float32", "point_shading": "flat"}
    return scene.add_point_cloud(name, np.zeros((1, 3), np.float32), (0, 0, 0), point_size=size, **style)


def show_points(handle: viser.PointCloudHandle, points: np.ndarray, colours: np.ndarray, size: float) -> None:
    """Gives a cloud new points (P, 3) in m of colours (P, 3) and `size` (m)."""
    handle.point_size = size
    handle.points, handle.colors = np.ascontiguousarray(points, np.float32), colours


def open_page(options: PageOptions, title: str) -> viser.ViserServer:
    """A page without content.

    Raises:
        ViewerError: the address or the port cannot be had.
    """
    import viser

    check_free(options)
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # a stray connection is no traceback's worth
    with _quiet():  # the line below says it, and who can reach the page
        server = viser.ViserServer(options.host, options.port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(PANEL_PIXELS)
    print(announcement(options), flush=True)
    if options.open_browser:
        webbrowser.open(f"http://{options.host}:{options.port}")
    return server


@contextmanager
def _quiet() -> Iterator[None]:
    """Without viser's own lines."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def announcement(options: PageOptions) -> str:
    """The line that tells where the page is and who can reach it."""
    if options.is_local:
        return f"viewer: http://{options.host}:{options.port} (reached from this machine alone; Ctrl-C ends it)"
    return (
        f"viewer: http://{options.host}:{options.port} (WHOEVER REACHES THIS MACHINE can look and take hold;"
        f" host={LOCALHOST} keeps it to this machine; Ctrl-C ends it)"
    )


def check_free(options: PageOptions) -> None:
    """Raises a ViewerError where the address or the port cannot be had; viser would quietly take the next port."""
    family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((options.host, options.port))
        except OSError as error:
            why = (error.strerror or str(error)).lower()
            no_address = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
            other = f"host={LOCALHOST}" if no_address else f"port={options.port + 1}"
            raise ViewerError(
                f"the viewer cannot listen on {options.host}:{options.port} ({why}); give another, such as {other}"
            ) from None
