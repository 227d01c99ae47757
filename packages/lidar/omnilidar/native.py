"""C++ functions of kernels, each in a header file of its own that editors and formatters understand."""

import re
from pathlib import Path


def function_body(header: str | Path) -> str:
    """The body of the one function in a header, for ``warp.func_native``, which writes the signature itself.

    Args:
        header: A file whose function begins with ``{`` and ends with ``}``, each on a line of its own without
            indentation. What stands before it, such as the signature and what it says, is for readers.
    """
    text = Path(header).read_text(encoding="utf-8")
    if text.count("\n{\n") != 1 or text.count("\n}\n") != 1:
        raise ValueError(f"{header}: one function was expected, its braces on lines of their own")
    return text.partition("\n{\n")[2].rpartition("}\n")[0]


def constant(header: str | Path, name: str) -> int:
    """The value of ``constexpr int name`` in a header, for Python code that needs it as well."""
    found = re.search(rf"constexpr int {name} = (-?\d+);", Path(header).read_text(encoding="utf-8"))
    if found is None:
        raise ValueError(f"{header}: constexpr int {name} was expected")
    return int(found[1])
