"""Objects whose state a checkpoint keeps: they name the attributes, and a resumed run goes on exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


class Stateful:
    """Saves and restores the attributes that it names.

    Tensors are copied, also those in dicts, lists and tuples; what has a state of its own, as another `Stateful`, is
    asked for it; None stays None.

    Attributes:
        saved: names of attributes that are replaced when a state is restored.
        buffers: names of tensors whose memory others hold, too: it is filled instead.
    """

    saved: Sequence[str] = ()
    buffers: Sequence[str] = ()

    def state_dict(self) -> dict[str, Any]:
        """Copies of what an exact resume needs."""
        return {name: copied(getattr(self, name)) for name in (*self.saved, *self.buffers)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resumes where `state_dict` was taken."""
        for name in self.saved:
            setattr(self, name, restored(getattr(self, name), state[name]))
        for name in self.buffers:
            if (buffer := getattr(self, name)) is not None:
                buffer.copy_(state[name])


def copied(value: Any) -> Any:
    """A copy of plain data, of tensors, or of the state of what has one."""
    if hasattr(value, "state_dict"):
        return value.state_dict()
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, dict):
        return {name: copied(part) for name, part in value.items()}
    return type(value)(map(copied, value)) if isinstance(value, list | tuple) else value


def restored(now: Any, saved: Any) -> Any:
    """What takes the place of `now`: itself, with its state restored, or a copy of what was saved."""
    if hasattr(now, "load_state_dict"):
        now.load_state_dict(saved)
        return now
    if isinstance(now, dict):
        return {name: restored(now.get(name), part) for name, part in saved.items()}
    return copied(saved)
