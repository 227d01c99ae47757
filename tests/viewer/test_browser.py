"""Operates the page in a real browser and reads back what became of it."""

from __future__ import annotations

import queue
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import chromium, control, open_tab, picture, pixel, wait_for

from omniperception.learning import latest_checkpoint
from omniperception.learning.checkpoint import load_checkpoint, save_checkpoint
from omniperception.viewer import PageOptions, Shown
from omniperception.viewer.stage import TARGET
from omniperception.viewer.viewer import Viewer

RUN = Path(__file__).parents[2] / "pretrained" / "avoider"
PORT = 18231


def state(viewer: Viewer) -> dict[str, Any]:
    """What is the case between two steps, in plain numbers."""
    answer: queue.Queue[dict[str, Any]] = queue.Queue()
    viewer.ask(lambda: answer.put(_state(viewer)))
    return answer.get(timeout=60.0)


def _state(viewer: Viewer) -> dict[str, Any]:
    session = viewer.session
    kinematics, field = session.env.state.kinematics, session.env.obstacles
    return {
        "time_s": session.time_s,
        "steps": session.env.step_count,
        "position": kinematics.base_pos_w[0].tolist(),
        "yaw": float(kinematics.yaw[0]),
        "driven": session.driven,
        "paused": viewer.paused,
        "checkpoint": str(session.checkpoint),
        "obstacles": field.root_pos_w[0].tolist(),
        "present": field.root_active[0].tolist(),
        "trials": len(session.outcomes),
        "message": viewer.message,
    }


def operate(viewer: Viewer, page: Any, pictures: Path) -> None:
    """Keys, an obstacle that is brought, time, and the weights."""
    page.goto(f"http://127.0.0.1:{PORT}")
    page.get_by_text("I command").wait_for()
    picture(page, pictures / "1_opened.png")

    assert state(viewer)["driven"] is None
    start = np.array(state(viewer)["position"][:2])
    (client,) = viewer.server.get_clients().values()
    eye = np.array(client.camera.position)
    for _ in range(3):
        page.keyboard.press("i")
    wait_for(lambda: state(viewer)["driven"] == (0.6, 0.0, 0.0), "three presses of I command 0.6 m/s")
    yaw = state(viewer)["yaw"]
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    wait_for(lambda: (np.array(state(viewer)["position"][:2]) - start) @ heading > 0.3, "the robot walks ahead")
    page.keyboard.press("x")
    wait_for(lambda: state(viewer)["driven"] == (0.0, 0.0, 0.0), "X stands")
    assert np.allclose(client.camera.position, eye, atol=1e-3), "keys that drive leave the view where it is"
    client.camera.position = tuple(eye + 2.0)
    page.keyboard.press("v")

    def at_robot() -> bool:
        offset = np.array(state(viewer)["position"][:2]) - viewer.stage.origin
        return bool(np.allclose(np.array(client.camera.look_at)[:2] - TARGET[:2], offset, atol=0.1))

    wait_for(lambda: np.allclose(client.camera.position, eye, atol=0.1) and at_robot(), "V looks at the robot")

    bring(viewer, page)
    page.keyboard.press("Space")
    wait_for(lambda: state(viewer)["paused"], "Space pauses")

    steps = state(viewer)["steps"]
    page.keyboard.press("n")
    wait_for(lambda: state(viewer)["steps"] == steps + 1, "N does one step")

    page.get_by_role("tab", name="Task").click()
    load(page, pictures / "none.pt")
    wait_for(lambda: "refused: no checkpoint at" in state(viewer)["message"], "weights that are not there are one line")
    load(page, pictures / "still.pt")
    wait_for(lambda: state(viewer)["checkpoint"] == str(pictures / "still.pt"), "other weights are loaded")
    page.get_by_role("tab", name="Drive").click()
    for _ in range(3):
        page.keyboard.press("i")
    wait_for(lambda: state(viewer)["driven"] == (0.6, 0.0, 0.0), "the command is that for other weights")
    before = state(viewer)
    viewer.ask(lambda: viewer.pause(False))
    wait_for(lambda: state(viewer)["time_s"] > before["time_s"] + 2.0, "time runs")
    after = state(viewer)
    heading = np.array([np.cos(before["yaw"]), np.sin(before["yaw"])])
    ahead = (np.array(after["position"][:2]) - before["position"][:2]) @ heading
    commanded = 0.6 * (after["time_s"] - before["time_s"])
    assert ahead < 0.5 * commanded, "weights of zero step on the spot, whatever the command"
    picture(page, pictures / "3_other_weights.png")


def bring(viewer: Viewer, page: Any) -> int:
    """Brings an obstacle by its key; its number."""
    there = state(viewer)["present"]
    page.keyboard.press("b")

    def brought() -> list[int]:
        return [k for k, present in enumerate(state(viewer)["present"]) if present and not there[k]]

    return wait_for(brought, "B brings an obstacle")[0]


def disturb(viewer: Viewer, page: Any, pictures: Path) -> None:
    """The mouse on an obstacle, and a second browser."""
    page.goto(f"http://127.0.0.1:{PORT}")
    client = wait_for(lambda: next(iter(viewer.server.get_clients().values()), None), "the page connects")
    page.get_by_text("I command").wait_for()
    page.keyboard.press("x")
    number = bring(viewer, page)
    drag(viewer, page, client, number)
    picture(page, pictures / "2_dragged.png")
    second = page.context.browser.new_page(viewport={"width": 300, "height": 200})
    second.goto(f"http://127.0.0.1:{PORT}")
    wait_for(lambda: len(viewer.server.get_clients()) == 2, "a second browser looks")
    second.close()
    wait_for(lambda: len(viewer.server.get_clients()) == 1, "it leaves")
    page.keyboard.press("x")
    wait_for(lambda: state(viewer)["driven"] == (0.0, 0.0, 0.0), "the first one drives on")


def load(page: Any, path: Path) -> None:
    """Names a file of weights on the page."""
    control(page, "weights file").fill(str(path))
    page.get_by_role("button", name="load weights file").click()


def write_still_weights(path: Path) -> None:
    """The run's weights with an actor that always gives 0, which is the default pose."""
    whole = load_checkpoint(latest_checkpoint(RUN))
    weights = whole["actor_state_dict"]
    last = max(name for name in weights if name.startswith("mlp.") and name.endswith(".weight")).removesuffix("weight")
    for name in ("weight", "bias"):
        weights[last + name] = torch.zeros_like(weights[last + name])
    save_checkpoint(path, {key: value for key, value in whole.items() if key not in ("format", "version")})


def drag(viewer: Viewer, page: Any, client: Any, obstacle: int) -> None:
    """Pulls an obstacle aside with the mouse; again where the browser's picture was too old to take hold of it."""
    start = state(viewer)
    before = np.array(start["obstacles"][obstacle])

    def follows() -> bool:
        now = state(viewer)
        assert now["trials"] == start["trials"]  # a new one would have put it elsewhere
        return bool(np.hypot(*(np.array(now["obstacles"][obstacle]) - before)[:2]) > 0.1)

    def pulled() -> bool:
        box = page.locator("canvas").first.bounding_box()
        middle = np.array([*(before[:2] - viewer.stage.origin), 0.3])
        x, y = pixel(client.camera, middle, box["width"], box["height"])
        page.mouse.move(box["x"] + x, box["y"] + y)
        page.mouse.down()
        page.mouse.move(box["x"] + x + 40, box["y"] + y, steps=5)
        time.sleep(1.0)
        page.mouse.up()
        return follows()

    wait_for(pulled, f"obstacle {obstacle} follows the mouse", 300.0)


@pytest.mark.parametrize("act", [operate, pytest.param(disturb, marks=pytest.mark.slow)])
def test_a_person_takes_hold_in_a_browser(tmp_path, act):
    pytest.importorskip("viser", reason="needs viser: pip install 'omniperception[viewer]'")
    endless = ("episode_length_s=10000", "min_base_height=0", "max_tilt_deg=180")  # whatever happens is one trial
    overrides = ("scenario=static", "condition=ideal", *(f"terminations.{setting}" for setting in endless))
    viewer = Viewer(Shown(RUN, overrides), PageOptions(port=PORT, stop_after_s=600))
    write_still_weights(tmp_path / "still.pt")
    failures: list[BaseException] = []

    def work() -> None:
        try:
            with chromium() as browser:
                act(viewer, open_tab(browser), tmp_path)
        except BaseException as failure:  # of the other thread: raised in this one
            failures.append(failure)
        finally:
            viewer.stop()

    operator = threading.Thread(target=work)
    operator.start()
    try:
        viewer.run()
    finally:
        operator.join()
        viewer.close()
    if failures:
        raise failures[0]
    assert not viewer.server.get_clients()
