"""Trials over the wire in real time: a simulated robot, a policy and its guard as processes, and tables of them."""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from omniperception.common.statistics import wilson
from omniperception.common.tables import markdown
from omniperception.deploy.faults import FAULTS, SENSORS
from omnirobot.common.files import write_whole
from omnirobot.common.shell import command_line
from omnirobot.runtime.description import FILE, DeployError, checksum

PROCESS_FAULTS = {
    "kill": "the policy's process is killed (SIGKILL) while the robot walks",
    "swap": "policy.json is another policy's",
}
NO_FAULT = "none"
KNOWN_FAULTS = (NO_FAULT, *PROCESS_FAULTS, *FAULTS)
_STANDING_UP_S = 10.0
_STARTUP_S = 600.0
"""Longest that the simulation may take to start."""
_FIRST_DOMAIN, _DOMAINS = 100, 100
_NOT_THE_SAME = "are not from the same export"
_LYING = 0.2
"""m: a base that is lower lies; it stands above 0.25."""


@dataclass(frozen=True)
class TrialsConfig:
    """What is tried.

    Attributes:
        run: run directory of the world's robot.
        policy: folder of the exported policy.
        out: folder of the results, a file for each trial.
        scenarios: of conf/scenario.
        faults: of KNOWN_FAULTS.
        trials: of each scenario and fault.
        limit_s: time from standing up within which the goal has to be reached.
        overrides: of the run's configuration.
        trust: packages of one's own that the run may name.
    """

    run: str
    policy: Path
    out: Path
    scenarios: Sequence[str]
    faults: Sequence[str]
    trials: int
    limit_s: float
    overrides: Sequence[str] = ()
    trust: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not (self.policy / FILE).is_file():
            line = command_line("export", f"run={self.run}", f"out={self.policy}")
            raise DeployError(f"policy={self.policy}: a folder that export has written was expected; write it: {line}")

    @property
    def made_with(self) -> dict:
        """What all results of a folder must share, as JSON gives it back."""
        return {
            "run": self.run,
            "policy": checksum(self.policy / FILE),  # which holds those of its other files
            "limit_s": self.limit_s,
            "overrides": list(self.overrides),
        }


def run(config: TrialsConfig) -> None:
    """Makes every trial whose file is not there yet.

    Raises:
        DeployError: the folder holds results of another run, policy, limit or other overrides.
    """
    config.out.mkdir(parents=True, exist_ok=True)
    made_with = config.made_with
    for path in _files(config.out):
        theirs = _result(path).get("made_with", {})
        differs = [name for name, value in made_with.items() if theirs.get(name) != value]
        if differs:
            name = differs[0]
            raise DeployError(
                f"out={config.out}: {path.name} is of another {name} ({theirs.get(name, 'unknown')}), not"
                f" {made_with[name]}; give another folder"
            )
    number = 0
    for scenario in config.scenarios:
        for fault in config.faults:
            for trial in range(config.trials):
                number += 1
                path = config.out / f"{scenario}-{fault}-{trial:03d}.json"
                if path.exists():
                    continue
                result = _trial(config, scenario, fault, trial, _FIRST_DOMAIN + number % _DOMAINS)
                write_whole(path, json.dumps({"made_with": made_with, **result}).encode())
                print(f"{path.name}: {_told(result)}", flush=True)


def _trial(config: TrialsConfig, scenario: str, fault: str, trial: int, domain: int) -> dict:
    """One trial's result."""
    work = config.out / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    policy = _swapped(config.policy, work / "policy") if fault == "swap" else config.policy
    lidar, steer = _free_port(), _free_port()
    words = [f"run={config.run}", f"scenario={scenario}", f"seed={1_000_000 + trial}", *config.overrides]
    words += [f"trust={','.join(config.trust)}"] if config.trust else []
    words += [f"domain={domain}", f"point_to={lidar}", f"steer_to={steer}", f"report={work / 'outcome.json'}"]
    words += [f"seconds={config.limit_s + _STANDING_UP_S}", *([f"fault={fault}"] if fault in FAULTS else [])]
    simulation = _Simulation(words)
    robot: subprocess.Popen | None = None
    try:
        simulation.await_line("robot-sim: ready", _STARTUP_S)
        wire = [f"policy={policy}", "points=packets", "host=127.0.0.1", f"point_port={lidar}", f"steer=udp:{steer}"]
        robot = _start_robot([*wire, f"domain={domain}", f"report={work / 'robot.json'}"], work / "robot.txt")
        if fault == "swap":
            robot.wait(_STARTUP_S)
            simulation.end(0.0)
        elif fault == "kill" and simulation.await_line("robot-sim: walks", _STARTUP_S):
            time.sleep(1.0)
            robot.kill()
        simulation.join(_STARTUP_S + 10 * config.limit_s)
    finally:
        if robot is not None and robot.poll() is None:
            robot.send_signal(signal.SIGINT)
            robot.wait(60.0)
        simulation.end(60.0)
    return {
        "scenario": scenario,
        "fault": fault,
        "trial": trial,
        "limit_s": config.limit_s,
        "outcome": _read(work / "outcome.json"),
        "robot": _read(work / "robot.json"),
        "robot_exit": None if robot is None else robot.returncode,
        "robot_said": (work / "robot.txt").read_text(errors="replace")[-2000:],
    }


def _swapped(policy: Path, folder: Path) -> Path:
    """A copy of an exported policy whose description is not the network's: another scale of actions."""
    shutil.copytree(policy, folder)
    described = json.loads((folder / FILE).read_text())
    described["joints"]["action_scale"] = 1.0
    (folder / FILE).write_text(json.dumps(described))
    return folder


class _Simulation:
    """A `robot-sim` in a process of its own, forked from one that has imported it: which takes longer than a walk."""

    _CONTEXT = multiprocessing.get_context("forkserver")

    def __init__(self, words: Sequence[str]) -> None:
        """Args: words: of its command line."""
        self._CONTEXT.set_forkserver_preload(["omniperception.commands.robot_sim"])
        said, says = self._CONTEXT.Pipe(duplex=False)
        self._process = self._CONTEXT.Process(target=_simulate, args=(list(words), says))
        self._process.start()
        says.close()
        self._said = os.fdopen(os.dup(said.fileno()), "rb", buffering=0)  # what select sees has not been read ahead

    def await_line(self, line: str, timeout_s: float) -> bool:
        """Whether it has said a line before it ended.

        Raises:
            DeployError: it ended with an error, or has not said it in time.
        """
        end = time.monotonic() + timeout_s
        while select.select([self._said], [], [], max(0.0, end - time.monotonic()))[0]:
            said = self._said.readline()
            if said.decode("utf-8", "replace").strip() == line:
                return True
            if not said:
                break
        else:
            raise DeployError(f"robot-sim has not said '{line}' within {timeout_s:g} s")
        self.join(10.0)
        if self._process.exitcode != 0:
            raise DeployError(f"robot-sim has ended with exit code {self._process.exitcode}; its message stands above")
        return False

    def join(self, timeout_s: float) -> None:
        """Waits until it has ended."""
        self._process.join(timeout_s)

    def end(self, timeout_s: float) -> None:
        """Interrupts it, if it has not ended."""
        if self._process.is_alive() and self._process.pid is not None:
            os.kill(self._process.pid, signal.SIGINT)
            self.join(timeout_s)


def _simulate(words: list[str], says: Connection) -> None:
    """The simulation's process: what it prints goes to `says`, and an interrupt ends it wherever it was started."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(says.fileno(), 1)
    sys.argv[1:] = ["robot-sim", *words]
    runpy.run_module("omniperception", run_name="__main__")


def _start_robot(words: Sequence[str], said: Path) -> subprocess.Popen:
    """A `robot` as a process that an interrupt ends, also where this one was started in the background; what it and its
    guard say goes into a file."""

    def interruptible() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    command = [sys.executable, "-m", "omniperception", "robot", *words]
    with said.open("wb") as file:
        return subprocess.Popen(command, preexec_fn=interruptible, stderr=file)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def _read(path: Path) -> dict | None:
    return json.loads(path.read_text()) if path.exists() else None


def _told(result: dict) -> str:
    """A trial in words."""
    outcome = result["outcome"] or {}
    if not outcome.get("stood"):
        said = result.get("robot_said", "").strip().rpartition("\n")[2]
        return "refused before a motor moved" if _is_refused(result) else f"never stood up ({said})"
    did = [name for name in ("reached", "touched", "fell") if outcome[name]]
    did.append("lay at the end" if outcome["height"] < _LYING else f"{outcome['speed']:.1f} m/s at the end")
    return ", ".join(did)


def _is_refused(result: dict) -> bool:
    """Whether `robot` has refused a description that is not the network's, and for no other reason."""
    stood = (result["outcome"] or {}).get("stood")
    return not stood and result["robot_exit"] == 2 and _NOT_THE_SAME in result.get("robot_said", "")


def results(folder: Path) -> list[dict]:
    """Of all trials in a folder.

    Raises:
        DeployError: there is none, or one cannot be read.
    """
    found = [_result(path) for path in _files(folder)]
    if not found:
        raise DeployError(f"{folder} holds no results of trials")
    return found


def _result(path: Path) -> dict:
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError):
        raise DeployError(f"{path} is no result of a trial; delete it, and the same command makes it again") from None


def _files(folder: Path) -> list[Path]:
    """Of results, in order."""
    return sorted(folder.glob("*-*-*.json"))


_OUTCOMES = ("scenario", "fault", "trials", "untouched at the goal", "touched", "fell", "lay at the end", "refused")
_TIMES = (
    *("scenario", "fault", "steps", "p50", "p99", "begin late: p50", "p99", "late steps", "skipped", "frames"),
    *("missed", "late points", "packets lost", "lag"),
)


def table(trials: Sequence[dict]) -> str:
    """Outcomes and timing, in Markdown; rates with 95 % Wilson intervals."""
    rows, timing = [], []
    for key in dict.fromkeys((trial["scenario"], trial["fault"]) for trial in trials):
        group = [trial for trial in trials if (trial["scenario"], trial["fault"]) == key]
        rows.append([*key, len(group), *(_share(happened, len(group)) for happened in _counts(group))])
        timing.append([*key, *_timing(group)])
    notes = (
        "Steps and their beginnings in ms; late: more than half a period; skipped: cost by a stall; missed: frames that"
        " were due and did not come; lag: most behind real time, ms (median, max)."
    )
    return "\n\n".join((markdown(_OUTCOMES, rows), markdown(_TIMES, timing), notes))


def _counts(group: Sequence[dict]) -> list[int]:
    """How many arrived untouched, touched, fell, lay, were refused."""
    outcomes = [trial["outcome"] or {} for trial in group]
    stood = [(trial, o) for trial, o in zip(group, outcomes, strict=True) if o.get("stood")]
    arrived = [o for trial, o in stood if _arrived(o, trial["limit_s"])]
    lying = [o for _, o in stood if o["height"] < _LYING and not o["fell"]]
    refused = [trial for trial in group if _is_refused(trial)]
    return [len(arrived), _sum(stood, "touched"), _sum(stood, "fell"), len(lying), len(refused)]


def _arrived(outcome: dict, limit_s: float) -> bool:
    """At the goal in time, untouched and on its feet."""
    in_time = outcome["reached_s"] is not None and outcome["reached_s"] <= limit_s
    return in_time and not outcome["touched"] and not outcome["fell"]


def _sum(stood: Iterable[tuple[dict, dict]], key: str) -> int:
    return sum(bool(outcome[key]) for _, outcome in stood)


def _share(count: int, trials: int) -> str:
    low, high = wilson(count, trials)
    return f"{count} ({100 * count / trials:.0f} % [{100 * low:.0f}, {100 * high:.0f}])"


def _timing(group: Sequence[dict]) -> list[str]:
    """Cells of the second table."""
    reports = [trial["robot"] for trial in group if trial["robot"] is not None and trial["robot"]["step_ms"]]
    lags = [1e3 * trial["outcome"]["lag_s"] for trial in group if trial["outcome"] is not None]
    lag = f"{np.median(lags):.0f}, {max(lags):.0f}" if lags else "-"
    if not reports:
        return ["-"] * 11 + [lag]
    steps = np.concatenate([report["step_ms"] for report in reports])
    begins = np.concatenate([report["begin_ms"] for report in reports])
    late = np.concatenate([np.array(report["begin_ms"]) > report["period_ms"] / 2 for report in reports])
    names = ("steps skipped", "frames missed", "late points", "packets lost")
    skipped, missed, old, lost = (_counted([report["counts"] for report in reports], name) for name in names)
    numbers = [*np.percentile(steps, (50, 99)), *np.percentile(begins, (50, 99))]
    frames = sum(report["frames"] for report in reports)
    share = f"{int(late.sum())} ({100 * late.mean():.1f} %)"
    return [
        *(str(len(steps)), *(f"{number:.2f}" for number in numbers), share),
        *(skipped, str(frames), missed, old, lost, lag),
    ]


def _counted(counts: Sequence[dict], name: str) -> str:
    """The sum of a count; "-" where one of the trials has not counted it."""
    return str(sum(count[name] for count in counts)) if all(name in count for count in counts) else "-"


__all__ = ["KNOWN_FAULTS", "NO_FAULT", "PROCESS_FAULTS", "SENSORS", "TrialsConfig", "results", "run", "table"]
