"""Downloads robots that others publish: a package by pip, without what it depends on, checked and unpacked."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from omniperception.scene.fetched import cache
from omnirobot.common.errors import ConfigError
from omnirobot.common.shell import command_line


@dataclass(frozen=True)
class Package:
    """A wheel on PyPI with robots in it.

    Attributes:
        name: of the package.
        version: of it.
        wheel: its file.
        sha256: of the file, as PyPI has it.
        inside: folder of the wheel that holds the robots.
        robots: folder of each, in `inside`, by preset.
        licence: of the files.
    """

    name: str
    version: str
    wheel: str
    sha256: str
    inside: str
    robots: Mapping[str, str]
    licence: str

    @property
    def folder(self) -> Path:
        """Where its robots lie once they are there."""
        return cache() / f"{self.name}-{self.version}"


MJLAB = Package(
    name="mjlab",
    version="1.6.0",
    wheel="mjlab-1.6.0-py3-none-any.whl",
    sha256="03d003854e2f44c48330c6dcf4c2253ff7641bb569747846825a21b9efa8540b",
    inside="mjlab/asset_zoo/robots/",
    robots={"go1": "unitree_go1", "g1": "unitree_g1"},
    licence="Apache-2.0",
)


def fetch(package: Package, wheel: Path | None = None) -> Path:
    """Puts a package's robots into the cache; returns their folder, which is whole or not there.

    Args:
        package: what is wanted.
        wheel: a copy that is here already; None: pip downloads it.

    Raises:
        ConfigError: one line: no pip, no network, or a file that is not the one expected.
    """
    cache().mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache()) as scratch:
        path = wheel or _download(package, Path(scratch))
        _check(package, path)
        unpacked = Path(scratch) / "unpacked"
        _unpack(package, path, unpacked)
        shutil.rmtree(package.folder, ignore_errors=True)
        unpacked.rename(package.folder)
    return package.folder


def _download(package: Package, folder: Path) -> Path:
    """The wheel, brought by pip, which checks its hash too; nothing is installed."""
    wanted = folder / "wanted.txt"
    wanted.write_text(f"{package.name}=={package.version} --hash=sha256:{package.sha256}\n")
    options = ["--no-deps", "--only-binary=:all:", "--require-hashes", "--quiet", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "download", *options, "--dest", str(folder), "-r", str(wanted)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        said = [line for line in done.stderr.splitlines() if line.strip()] or ["it said nothing"]
        raise ConfigError(
            f"pip could not download {package.name}=={package.version} ({said[-1].strip()}); with a copy from"
            f" elsewhere: {command_line('robot-fetch', f'wheel={package.wheel}')}"
        )
    return folder / package.wheel


def _check(package: Package, path: Path) -> None:
    if not path.is_file():
        raise ConfigError(f"wheel={path} is no file; {package.wheel} was expected")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != package.sha256:
        raise ConfigError(f"{path} has SHA-256 {found}; that of {package.wheel} is {package.sha256}: delete the file")


def _unpack(package: Package, path: Path, folder: Path) -> None:
    """The folders of the robots, and the licences beside them."""
    with zipfile.ZipFile(path) as archive:
        for robot in package.robots.values():
            prefix = f"{package.inside}{robot}/xmls/"
            for name in (name for name in archive.namelist() if name.startswith(prefix) and not name.endswith("/")):
                _write(archive, name, folder / robot / "xmls" / name.removeprefix(prefix))
        for name in (name for name in archive.namelist() if ".dist-info/licenses/" in name):
            _write(archive, name, folder / "licenses" / Path(name).name)


def _write(archive: zipfile.ZipFile, name: str, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(archive.read(name))
