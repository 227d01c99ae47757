"""Puts conf/ and pretrained/, at the top of a checkout, into the package; all else is in pyproject.toml."""

from setuptools import find_namespace_packages, setup

data = [f"omniperception.{top}.{below}" for top in ("conf", "pretrained") for below in find_namespace_packages(top)]
setup(
    packages=[
        *find_namespace_packages(include=["omniperception*"], exclude=["*__pycache__*"]),
        "omniperception.conf",
        "omniperception.pretrained",
        *data,
    ],
    package_dir={"omniperception.conf": "conf", "omniperception.pretrained": "pretrained"},
)
