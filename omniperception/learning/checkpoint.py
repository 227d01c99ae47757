"""Checkpoint files: written atomically, read with ``weights_only``, found by iteration number."""

from __future__ import annotations

import io
import os
import pickle
import random
import re
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from omniperception.common.checkpoints import checkpoint_path, list_checkpoints
from omnirobot.common.errors import UserError, of_a_disk
from omnirobot.common.files import write_whole
from omnirobot.common.shell import command_line

FORMAT = "omniperception-checkpoint"
VERSION = 1

_LAYER = re.compile(r"mlp\.(?:network\.)?(\d+)\.weight")


class CheckpointError(UserError, RuntimeError):
    """A checkpoint is missing, damaged, foreign or does not fit what it is loaded into."""


def latest_checkpoint(run_dir: str | os.PathLike) -> Path:
    """The checkpoint of a run with the most iterations."""
    found = list_checkpoints(run_dir)
    if not found:
        raise CheckpointError(
            f"no checkpoint in {Path(run_dir) / 'checkpoints'}: give a run directory that has"
            " saved one, or start without resuming"
        )
    return found[-1]


def prune_checkpoints(run_dir: str | os.PathLike, keep: int) -> None:
    """Delete all but the last ``keep`` checkpoints of a run."""
    for path in list_checkpoints(run_dir)[:-keep]:
        path.unlink(missing_ok=True)


def save_checkpoint(path: str | os.PathLike, state: Mapping) -> None:
    """Write ``state`` so that ``path`` is always either absent, the old file or the complete new one.

    Raises:
        CheckpointError: it cannot be written, as on a full disk; the older ones are named.
    """
    path, content = Path(path), io.BytesIO()
    torch.save({"format": FORMAT, "version": VERSION, **portable(state)}, content)  # whose error on a disk says nothing
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content.getbuffer(), durable=True)
    except OSError as error:
        run_dir = path.parent.parent
        older = ", ".join(found.name for found in list_checkpoints(run_dir)[-3:])
        goes_on = f"; {command_line('train', f'run={run_dir}')} goes on from the last of {older}" if older else ""
        raise CheckpointError(f"{path} cannot be written: {of_a_disk(error) or error}{goes_on}") from None


def load_checkpoint(path: str | os.PathLike, map_location: str | torch.device | None = None) -> dict:
    """Read a checkpoint without running any code from it."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: give a file such as {checkpoint_path('<run>', 100)}")
    try:
        content = torch.load(path, weights_only=True, map_location=map_location)
    except (OSError, pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, struct.error) as error:
        if isinstance(error, OSError) and of_a_disk(error):
            raise CheckpointError(f"{path} cannot be read: {of_a_disk(error)}") from error
        older = [found.name for found in list_checkpoints(path.parent.parent) if found != path]
        remedy = f"without it, {older[-1]} is the newest: delete it" if older else "give another run"
        raise CheckpointError(
            f"{path} ({path.stat().st_size:,} bytes) is damaged or no checkpoint of this program; {remedy}"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of this program: it has no format '{FORMAT}'")
    if content.get("version") != VERSION:
        raise CheckpointError(f"{path} has checkpoint version {content.get('version')}, this program reads {VERSION}")
    return content


def difference(own: Mapping[str, torch.Tensor], other: Mapping[str, torch.Tensor]) -> str | None:
    """What keeps the weights of an actor out of another one, in words.

    Args:
        own: state of the actor that is to take them.
        other: the weights.

    Returns:
        None where they fit.
    """
    layers, others = _layers(own), _layers(other)
    if not others:
        return "they are no actor's"
    if others[-1][0] != layers[-1][0]:
        return f"they move {others[-1][0]} joints, this robot has {layers[-1][0]}"
    for part, with_it, without in (
        ("perception.", "perceive with LiDAR", "walk blind"),
        ("estimator.", "estimate the base's velocity", "read the base's velocity"),
    ):
        mine, theirs = (any(name.startswith(part) for name in state) for state in (own, other))
        if mine != theirs:
            return f"they {with_it if theirs else without}, this run is to {with_it if mine else without}"
    if others[0][1] != layers[0][1]:
        return f"they read {others[0][1]} numbers, this run has {layers[0][1]}: other observations or another embedding"
    if others != layers:
        return f"their hidden layers have {_widths(others)} units, here {_widths(layers)}"
    for name, tensor in own.items():
        if name not in other:
            return f"they lack {name}"
        if other[name].shape != tensor.shape:
            return f"their {name} has shape {tuple(other[name].shape)}, here {tuple(tensor.shape)}"
    unknown = next((name for name in other if name not in own), None)
    return None if unknown is None else f"they have {unknown}, which nothing here takes"


def _layers(state: Mapping[str, torch.Tensor]) -> list[tuple[int, int]]:
    """Outputs and inputs of the layers of an actor's MLP, first to last."""
    found = [(int(match[1]), name) for name in state if (match := _LAYER.fullmatch(name))]
    return [(state[name].shape[0], state[name].shape[1]) for _, name in sorted(found)]


def _widths(layers: list[tuple[int, int]]) -> list[int]:
    return [outputs for outputs, _ in layers[:-1]]


def portable(value, where: str = "state"):
    """``value`` with NumPy arrays as tensors; an error names what ``weights_only`` loading would refuse.

    Tensors, numbers, strings, bytes and None may be nested in dicts, lists and tuples. Tensors that are views
    of a larger storage are copied, so that only their own elements are written.
    """
    if isinstance(value, torch.Tensor):
        tensor = value.detach()
        whole = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
        return tensor if whole else tensor.clone()
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            raise CheckpointError(f"cannot save {where}: an array of Python objects; use numbers")
        return torch.from_numpy(np.array(value, copy=True))
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: portable(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        items = [portable(item, f"{where}[{i}]") for i, item in enumerate(value)]
        return items if isinstance(value, list) else tuple(items)
    if value is None or isinstance(value, bool | int | float | str | bytes):
        return value
    raise CheckpointError(
        f"cannot save {where}: a {type(value).__name__}; use tensors, arrays, numbers, strings, lists or dicts"
    )


def rng_state() -> dict:
    """States of the global random generators of torch (all devices), NumPy and Python."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [name, torch.from_numpy(np.asarray(keys).astype(np.int64)), position, has_gauss, gauss],
        "python": random.getstate(),
    }


def set_rng_state(state: dict) -> None:
    """Restore what :func:`rng_state` returned; states of devices that are not there are skipped."""
    torch.set_rng_state(state["torch"].cpu())
    if torch.cuda.is_available():
        for device, cuda_state in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(cuda_state.cpu(), device)
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), position, has_gauss, gauss))
    version, internal, gauss_next = state["python"]
    random.setstate((version, tuple(internal), gauss_next))
