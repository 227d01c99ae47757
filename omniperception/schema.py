"""Values of a configuration, checked against the types of the dataclasses and functions that take them."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import yaml
from hydra.utils import get_object

from omniperception.config import CONFIG_DIR, OPTIONAL_GROUPS, SEARCH_PATH, ConfigError, UnknownKey

_SEQUENCES = (tuple, list, Sequence)
_MAPPINGS = (dict, Mapping)
_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


TOP: dict[str, Any] = {"seed": int, "num_envs": int, "init": str | list[str] | None, SEARCH_PATH: list[str]}
"""Keys of a configuration beside its groups, and their types."""


def check_config(composed: Mapping[str, object]) -> None:
    """Checks a resolved configuration: every key is one that something takes, and has a value of its type.

    Raises:
        ConfigError: names the key.
    """
    groups = {path.name for path in CONFIG_DIR.iterdir() if path.is_dir()} - set(OPTIONAL_GROUPS)
    for key, value in composed.items():
        if key not in TOP and key not in groups:
            raise UnknownKey(key, {*TOP, *groups})
        check_value(value, TOP.get(key, dict[str, Any] | None), key)
    check_tree(composed)


def check_tree(node: object, key: str = "") -> None:
    """Checks every node with a `_target_` in a resolved configuration.

    Raises:
        ConfigError: names the key; a target does not take it, or takes a value of another type.
    """
    if isinstance(node, Mapping):
        if "_target_" in node:
            arguments = {str(name): value for name, value in node.items() if not str(name).startswith("_")}
            check_call(get_object(node["_target_"]), arguments, key)
        for name, value in node.items():
            check_tree(value, f"{key}.{name}" if key else str(name))


def check_call(target: Callable[..., Any], arguments: Mapping[str, object], key: str, skip: int = 0) -> None:
    """Checks names and types of arguments that a configuration gives.

    Args:
        target: a class or a function with annotations; what is not annotated is not checked.
        arguments: by name.
        key: where they stand, such as `lidar.sensor`.
        skip: how many leading parameters the configuration does not give, such as a term's state.
    """
    parameters = list(inspect.signature(target).parameters.values())[skip:]
    hints = _hints(target)
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        known = [parameter.name for parameter in parameters]
        for name in arguments:
            if name not in known:
                raise UnknownKey(f"{key}.{name}", known)
    for name, value in arguments.items():
        check_value(value, hints.get(name, Any), f"{key}.{name}")


def check_value(value: object, hint: Any, key: str) -> None:
    """Checks one value; what is built from a node of its own, and types that YAML does not have, are left alone."""
    if not _fits(value, hint):
        shown = yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
        raise ConfigError(f"{key}={shown} must be {_expected(hint)}")


@cache
def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    """Types of the parameters, but for those that name what only type checkers import."""
    sources: list[Any] = [target]
    if inspect.isclass(target):
        sources = target.__mro__[::-1] if dataclasses.is_dataclass(target) else [target.__init__]
    hints = {}
    for source in sources:
        names = vars(sys.modules[source.__module__])
        for name, hint in getattr(source, "__annotations__", {}).items():
            with contextlib.suppress(NameError):
                hints[name] = eval(hint, names) if isinstance(hint, str) else hint
    return hints


def _fits(value: object, hint: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(value, Mapping) and "_target_" in value:
        return hint not in _NAMES
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in args)
    if origin is typing.Literal:
        return value in args
    if hint is types.NoneType:
        return value is None
    if hint is bool or hint is str:
        return isinstance(value, hint)
    if hint is int or hint is float:
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    if origin is tuple and isinstance(value, list):
        if args[-1] is Ellipsis:
            return all(_fits(item, args[0]) for item in value)
        return len(value) == len(args) and all(map(_fits, value, args))
    if origin in _SEQUENCES:
        return isinstance(value, list) and all(_fits(item, args[0]) for item in value)
    if origin in _MAPPINGS:  # an item of null is left out
        return isinstance(value, Mapping) and all(item is None or _fits(item, args[1]) for item in value.values())
    if hint is Any or origin is not None or isinstance(hint, typing.TypeVar):
        return True
    return isinstance(value, Mapping)  # an object is built from a node of its own


def _expected(hint: Any) -> str:
    """A type in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint in _NAMES:
        return _NAMES[hint]
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_expected(part) for part in args)
    if hint is types.NoneType:
        return "null"
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, args))}"
    if origin in _SEQUENCES:
        count = f"{len(args)} " if origin is tuple and args[-1] is not Ellipsis else ""
        plural = {bool: "of true or false", int: "whole numbers", float: "numbers", str: "texts"}.get(args[0], "values")
        return f"a list of {count}{plural}"
    return "a group of settings"
