"""Memory: bytes of the buffers below objects."""

from __future__ import annotations

from omniperception.plan import buffers, walk


def buffer_bytes(*roots: object) -> int:
    """Bytes of all arrays of torch, NumPy and Warp that can be reached from the roots; what is shared counts once."""
    return sum(buffers(walk({str(k): root for k, root in enumerate(roots)})).values())
