"""Scan patterns: the directions in which a sensor looks, as a function of time, and which of them are kept."""

from .custom import custom
from .grid import grid, height_scanner
from .livox import LIVOX, avia, hap, horizon, mid40, mid70, mid360, mid360_measured, tele15
from .selection import Selection, make_selection
from .spinning import airy, hdl32e, hdl64e, os0, os1, os2, ouster, spinning, vlp16, vlp32c, xt16, xt32
from .table import ROW_SLACK, ScanPattern
from .unitree import unitree_l1, unitree_l2

__all__ = [
    "LIVOX",
    "ROW_SLACK",
    "ScanPattern",
    "Selection",
    "airy",
    "avia",
    "custom",
    "grid",
    "hap",
    "hdl32e",
    "hdl64e",
    "height_scanner",
    "horizon",
    "make_selection",
    "mid40",
    "mid70",
    "mid360",
    "mid360_measured",
    "os0",
    "os1",
    "os2",
    "ouster",
    "spinning",
    "tele15",
    "unitree_l1",
    "unitree_l2",
    "vlp16",
    "vlp32c",
    "xt16",
    "xt32",
]
