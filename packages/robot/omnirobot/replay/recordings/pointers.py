"""Git LFS: what lies in a checkout in place of large files that have not been fetched."""

from pathlib import Path

POINTER = b"version https://git-lfs"


def refuse_pointer(path: Path) -> None:
    """Says how to fetch a file of which only the pointer is there.

    Raises:
        ValueError: It is one.
    """
    with path.open("rb") as file:
        if file.read(len(POINTER)) == POINTER:
            raise ValueError(f"{path} is a pointer of Git LFS, not the file itself: run 'git lfs pull' in its checkout")
