"""Memory: bytes of the buffers below objects, and of this process."""

from __future__ import annotations

from pathlib import Path

from omniperception.plan import buffers, walk

_STATUS = Path("/proc/self/status")


def buffer_bytes(*roots: object) -> int:
    """Bytes of all arrays of torch, NumPy and Warp that can be reached from the roots; what is shared counts once."""
    return sum(buffers(walk({str(k): root for k, root in enumerate(roots)})).values())


def resident_bytes(peak: bool = False) -> int:
    """Bytes of this process in memory, now or at most; the most so far on systems without /proc."""
    if not _STATUS.is_file():
        import resource

        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    key = "VmHWM:" if peak else "VmRSS:"
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])
