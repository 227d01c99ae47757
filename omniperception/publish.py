"""Strips a run of everything that replaying, evaluating and starting from it do not need."""

from __future__ import annotations

import shutil
from pathlib import Path

from omegaconf import OmegaConf

from omniperception import config
from omniperception.common import provenance
from omniperception.config import ConfigError
from omniperception.deploy.export import FOLDER as EXPORTED
from omniperception.evaluation.report.records import FOLDER as RESULTS
from omniperception.learning import latest_checkpoint, list_checkpoints
from omniperception.learning.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from omniperception.sim.response import FILE as RESPONSE

LIMIT = 4_000_000
"""Most bytes of a published checkpoint: it goes into a repository."""


def publish(run_dir: Path, folder: Path) -> dict:
    """Write a run directory that holds the newest weights, the configuration and where they come from.

    The critic stays, because a run that starts from this one may learn on, and so does the measured response of its
    gait, if it is of these weights; the optimisers, the environments' state and the logs go.

    Args:
        run_dir: a run.
        folder: becomes a run directory; weights, evaluations, exported policies and the measured response of an earlier
            publication go.

    Returns:
        What provenance.json holds.

    Raises:
        ConfigError: the weights are larger than LIMIT, the run is a published one, or `folder` holds something that is
            no earlier publication.
        CheckpointError: the run has no checkpoint.
    """
    newest = latest_checkpoint(run_dir)
    state = load_checkpoint(newest, "cpu")
    if "total_time" not in state:
        raise ConfigError(f"run={run_dir} was published already: it holds weights alone; give the run it came from")
    theirs = list_checkpoints(folder)
    if theirs and "total_time" in load_checkpoint(theirs[-1], "cpu"):
        raise ConfigError(f"to={folder} holds a training, whose checkpoints would be lost; give another folder")
    if not theirs and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"to={folder} is no earlier publication and not empty; give a new folder")
    weights = {name: state[name] for name in ("actor_state_dict", "critic_state_dict")}
    size = sum(tensor.numel() * tensor.element_size() for part in weights.values() for tensor in part.values())
    if size > LIMIT:
        raise ConfigError(
            f"{newest} has {size / 1e6:.1f} MB of weights, at most {LIMIT / 1e6:.0f} MB are published; train a smaller"
            " network"
        )
    composed = config.read(run_dir)
    for stale in ("checkpoints", RESULTS, EXPORTED):
        shutil.rmtree(folder / stale, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESPONSE).unlink(missing_ok=True)
    response = run_dir / RESPONSE
    if response.is_file() and response.stat().st_mtime_ns >= newest.stat().st_mtime_ns:  # not of earlier weights
        shutil.copy(response, folder)
    composed.pop(config.SEARCH_PATH, None)  # a folder of this machine
    composed.sim.num_threads = 0  # and how many of its cores
    plain = OmegaConf.to_container(composed)
    assert isinstance(plain, dict)
    config.save(plain, folder)
    save_checkpoint(checkpoint_path(folder, state["iteration"]), {**weights, "iteration": state["iteration"]})
    record = {
        **(provenance.read(run_dir) or provenance.provenance("cpu")),
        "run": str(run_dir),
        "init": plain.get("init"),
        "seed": composed.seed,
        "iterations": state["iteration"],
        "control_steps": state["logger"]["total_steps"],
        "training_hours": round(state["total_time"] / 3600, 3),
    }
    provenance.write(folder, record)
    return record
