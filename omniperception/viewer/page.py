"""Opens the page: checks address and port, says where it is and who can reach it."""

from __future__ import annotations

import errno
import logging
import queue
import socket
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from omniperception.viewer.options import LOCALHOST, PageOptions, ViewerError
from omnirobot.common.errors import ConfigError

if TYPE_CHECKING:
    import viser

PANEL_PIXELS = 440


class Page:
    """A page whose loop does, between two steps, what other threads ask for.

    Attributes:
        server: the page's.
        message: the newest line for whoever looks.
        refused: errors of a request that are told and do not end the loop.
    """

    refused: tuple[type[Exception], ...] = (ConfigError, ValueError, ImportError, OSError)

    def __init__(self, server: viser.ViserServer) -> None:
        self.server, self.message = server, ""
        self._requests: queue.Queue[Callable[[], None]] = queue.Queue()
        self._stopped, self._status_due = False, 0.0

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
