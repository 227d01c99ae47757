"""C++ functions of the kernels, from the header files beside this module.

A header holds one function that is C++ as it stands; the part between its outer braces becomes a Warp native function,
whose Python stub repeats the arguments. Integer constants that Python needs as well are read from the header.
"""

import re
from functools import cache
from importlib.resources import files


@cache
def _source(header: str) -> str:
    return (files(__package__) / header).read_text()


def body(header: str) -> str:
    """What lies between the outer braces of a header's function."""
    return "\n" + _source(header).partition("\n{\n")[2].rpartition("\n}\n")[0] + "\n"


def constant(header: str, name: str) -> int:
    """The value of ``constexpr int name``."""
    return int(re.search(rf"constexpr int {name} = (-?\d+);", _source(header))[1])
