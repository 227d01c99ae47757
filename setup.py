"""Puts conf/, at the top of a checkout, into the package as omniperception/conf; all else is in pyproject.toml."""

from setuptools import find_namespace_packages, setup

presets = [f"omniperception.conf.{group}" for group in find_namespace_packages("conf")]
setup(
    packages=[
        *find_namespace_packages(include=["omniperception*"], exclude=["*__pycache__*"]),
        "omniperception.conf",
        *presets,
    ],
    package_dir={"omniperception.conf": "conf"},
)
