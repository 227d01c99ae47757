"""Kernels compiled for what a scene has: each variant is built once, and only the newest ones are kept."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps

import warp as wp

MAX_VARIANTS = 64
"""Variants of kernels that a process keeps; a run has about three, one that builds scene after scene any number."""

_kept: OrderedDict[tuple, wp.Kernel] = OrderedDict()
_built = 0


def variants(build: Callable[..., wp.Kernel]) -> Callable[..., wp.Kernel]:
    """Keeps what ``build`` compiles for its (hashable, positional) arguments.

    Beyond MAX_VARIANTS, of all functions together, the one used longest ago is forgotten and its code unloaded;
    launches that were recorded with it keep theirs. Warp keeps compiled code on the disk, so that building it again
    only loads it.
    """

    @wraps(build)
    def kernel_for(*what: Hashable) -> wp.Kernel:
        global _built
        key = build.__qualname__, *what
        if key not in _kept:
            _kept[key] = build(*what)
            _built += 1
            while len(_kept) > MAX_VARIANTS:
                _, forgotten = _kept.popitem(last=False)
                forgotten.module.unload()
        _kept.move_to_end(key)
        return _kept[key]

    return kernel_for


def kept_variants() -> tuple[str, ...]:
    """Names of the kernels kept now, one for each variant, the one used longest ago first."""
    return tuple(kernel.key.rpartition("__")[2] for kernel in _kept.values())


def num_built() -> int:
    """Variants built since the process began, forgotten ones with them."""
    return _built
