"""How much memory this process has taken."""

from __future__ import annotations

from pathlib import Path

_STATUS = Path("/proc/self/status")


def resident_bytes(peak: bool = False) -> int:
    """Bytes of this process in memory, now or at most.

    On Linux they are the process's own: `ru_maxrss` would begin with those of the one that it came from. Elsewhere only
    that is known, the most so far.
    """
    if not _STATUS.is_file():
        import resource

        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    key = "VmHWM:" if peak else "VmRSS:"
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])
