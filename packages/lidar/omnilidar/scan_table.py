"""A scan pattern's table on the device, its rows in the order in which one sensor reads them."""

import math

import torch

from .patterns.table import ScanPattern


class ScanTable:
    """A repeating table laid out so that a frame of every ``stride``-th row reads neighbours in memory.

    Steps of ``stride`` through a table of M rows run along gcd(stride, M) cycles of equal length. The cycles are
    stored one after the other, each in the order of the steps: a frame is a run within one cycle, and a ray fetches
    its direction from the cache line of the ray before it.

    Attributes:
        directions: Unit vectors in the sensor frame, (M, 3) float32.
        origins: Where the rays start in the sensor frame, metres, (M, 3) float32; None: at the sensor's origin.
        angles: Elevation and azimuth, rad, (M, 2) float32; None unless asked for.
        cycle: Rows per cycle.
        start: First row of the current frame: where its cycle starts and how far into it, (num_envs, 2) int32.
    """

    def __init__(self, pattern: ScanPattern, stride: int, num_envs: int, angles: bool, device: torch.device) -> None:
        num_rows = pattern.num_rows
        self._num_cycles = math.gcd(stride, num_rows)
        self.cycle = num_rows // self._num_cycles
        self._inverse = pow(stride // self._num_cycles, -1, self.cycle)
        steps = torch.arange(self.cycle) * stride
        order = (torch.arange(self._num_cycles)[:, None] + steps).remainder_(num_rows).flatten()

        def lay_out(rows: torch.Tensor) -> torch.Tensor:
            return rows[order].to(device=device, dtype=torch.float32).contiguous()

        self.directions = lay_out(pattern.directions_s)
        self.origins = None if pattern.origins_s is None else lay_out(pattern.origins_s)
        self.angles = lay_out(torch.stack((pattern.elevation, pattern.azimuth), 1)) if angles else None
        self.start = torch.zeros(num_envs, 2, dtype=torch.int32, device=device)
        self._scratch = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def seek(self, first_row: torch.Tensor) -> None:
        """Sets ``start`` from each frame's first row of the pattern, (num_envs,) int64 in 0..M-1."""
        scratch = self._scratch
        if self._num_cycles > 1:
            torch.remainder(first_row, self._num_cycles, out=scratch)
            self.start[:, 0].copy_(scratch.mul_(self.cycle))
        torch.div(first_row, self._num_cycles, rounding_mode="floor", out=scratch)
        self.start[:, 1].copy_(scratch.mul_(self._inverse).remainder_(self.cycle))
