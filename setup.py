"""Puts conf/ and pretrained/, at the top of a checkout, into the package, and brings the two packages beside it that it
needs; all else is in pyproject.toml."""

from pathlib import Path

from setuptools import find_namespace_packages, setup

data = [f"omniperception.{top}.{below}" for top in ("conf", "pretrained") for below in find_namespace_packages(top)]
beside = Path(__file__).resolve().parent / "packages"
setup(
    packages=[
        *find_namespace_packages(include=["omniperception*"], exclude=["*__pycache__*"]),
        "omniperception.conf",
        "omniperception.pretrained",
        *data,
    ],
    package_dir={"omniperception.conf": "conf", "omniperception.pretrained": "pretrained"},
    install_requires=[f"omni{name} @ {(beside / name).as_uri()}" for name in ("lidar", "robot")],
)
