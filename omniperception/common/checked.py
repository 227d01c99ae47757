"""Configuration dataclasses whose fields declare what values they take; pydantic checks them.

@checked("ppo")
class PPOConfig:
    gamma: Share
    learning_rate: Positive

PPOConfig(gamma=1.5, learning_rate=1e-3)  # ValueError: ppo.gamma=1.5 must lie in [0, 1]
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

_Class = TypeVar("_Class", bound=type)


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


def _in_order(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] <= ends[1]:
        raise ValueError
    return ends


def _area(bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
        raise ValueError
    return bounds


AsTuple, InOrder = BeforeValidator(_tuple), AfterValidator(_in_order)
_ABOVE_0, _FROM_0, _FROM_1 = Field(gt=0), Field(ge=0), Field(ge=1)
Positive = Annotated[float, _ABOVE_0, "positive"]
NonNegative = Annotated[float, _FROM_0, "not negative"]
Share = Annotated[float, Field(ge=0, le=1), "in [0, 1]"]
AtLeastOne = Annotated[int, _FROM_1, "at least 1"]
Count = Annotated[int, _FROM_0, "not negative"]
Pair = Annotated[tuple[float, float], AsTuple, InOrder, "[low, high] with low <= high"]
"""Ends of a range."""
PositivePair = Annotated[tuple[Annotated[float, _ABOVE_0], float], AsTuple, InOrder, "[low, high] with 0 < low <= high"]
NonNegativePair = Annotated[
    tuple[Annotated[float, _FROM_0], float], AsTuple, InOrder, "[low, high] with 0 <= low <= high"
]
Positives = Annotated[
    tuple[Annotated[float, _ABOVE_0], ...], AsTuple, Field(min_length=1), "at least one, all positive"
]
Point = Annotated[tuple[float, float, float], AsTuple, "[x, y, z]"]
Area = Annotated[tuple[float, float, float, float], AsTuple, AfterValidator(_area), "[x_low, x_high, y_low, y_high]"]
Widths = Annotated[
    tuple[Annotated[int, _FROM_1], ...], AsTuple, Field(min_length=1), "widths of hidden layers, one or more"
]
Cells = Annotated[
    tuple[Annotated[int, _FROM_1], Annotated[int, _FROM_1]], AsTuple, "[along x, along y], both at least 1"
]
Place2 = Annotated[tuple[float, float], AsTuple, "[x, y] (m)"]
Accelerations = Annotated[
    tuple[Annotated[float, _ABOVE_0], Annotated[float, _ABOVE_0]], AsTuple, "[m/s^2, rad/s^2], both positive"
]
Times = Annotated[tuple[Annotated[float, _FROM_0], ...], AsTuple, Field(min_length=1), "times (s) of at least 0"]
Counts = Annotated[tuple[Annotated[int, _FROM_0], ...], AsTuple, "whole numbers from 0 on"]
Cell = Annotated[float, Field(gt=0, le=0.5), "in (0, 0.5]"]
Text = Annotated[str, Field(min_length=1), "text that is not empty"]
Inside = Annotated[float, Field(gt=0, lt=1), "between 0 and 1"]
Names = Annotated[tuple[str, ...], AsTuple, "a list of texts"]


@typing.dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def checked(key: str = "") -> Callable[[_Class], _Class]:
    """Makes a frozen dataclass that checks types and declared bounds when it is built; lists become tuples.

    A value that does not fit is a ValueError of one line, `<key>.<field>=<value> must be <what the type says>`. A
    subclass is checked as well, undecorated, too; `@dataclass`, which would lose the bounds, is a TypeError there.

    Args:
        key: where it stands in a configuration, such as `terrain.curriculum`; or other words that end with a space.
    """

    def decorate(cls: _Class) -> _Class:
        if "__pydantic_fields__" not in vars(cls):  # it has no base that is checked
            _check(cls)
        cls._checked_as = key if key.endswith(" ") or not key else f"{key}."  # type: ignore[attr-defined]
        return cls

    return decorate


def _check(cls: Any) -> None:
    made = dataclass(frozen=True, config=_STRICT)(cls)
    assert made is cls
    build = cls.__init__

    @functools.wraps(build)
    def __init__(self: Any, *args: Any, **keywords: Any) -> None:
        try:
            build(self, *args, **keywords)
        except ValidationError as error:
            given = inspect.signature(cls).bind_partial(*args, **keywords).arguments
            raise _refusal(error, cls, given, type(self)._checked_as) from None

    for name, function in (("__init__", __init__), ("__init_subclass__", classmethod(_check))):
        setattr(cls, name, function)


_STRICT = ConfigDict(strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)


def _refusal(error: ValidationError, cls: Any, given: dict[str, Any], before: str) -> Exception:
    """The first of pydantic's errors, in one line; what `__post_init__` raised, as it stands."""
    first = error.errors(include_url=False)[0]
    if not first["loc"]:
        return first["ctx"]["error"]
    place = first["loc"][0]
    name = [*given][place] if isinstance(place, int) else str(place)  # of an argument without its name
    if len(first["loc"]) == 1 and first["type"] in ("missing", "unexpected_keyword_argument"):
        return TypeError(f"{before}{name}: {first['msg']}")
    field, value = cls.__pydantic_fields__[name], given[name]
    hint = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    value = list(value) if isinstance(value, tuple) else value
    return ValueError(f"{before}{name}={value} must {expected(hint)}")


def expected(hint: Any, kinds: bool = False) -> str:
    """What a type asks of its values, in words that follow "must"; kinds: without the bounds of numbers."""
    first, *others = dict.fromkeys(_said(hint, kinds))
    verb = "" if first.startswith("not ") else "lie " if first.startswith("in ") else "be "
    return " or ".join([f"{verb}{first}".replace("not negative", "not be negative"), *others])


_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", types.NoneType: "null"}
_PLURALS = {int: "whole numbers", float: "numbers", str: "texts"}


def _said(hint: Any, kinds: bool) -> Iterator[str]:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        own = [word for word in args[1:] if isinstance(word, str)]
        yield from own if own and not (kinds and args[0] in _WORDS) else _said(args[0], kinds)
    elif origin in (typing.Union, types.UnionType):
        for option in args:
            yield from _said(option, kinds)
    elif origin is Literal:
        yield f"one of {', '.join(map(str, args))}"
    elif origin in (tuple, list, Sequence):
        count = f"{len(args)} " if origin is tuple and args[-1] is not Ellipsis else ""
        yield f"a list of {count}{_PLURALS.get(args[0], 'lists')}"
    else:
        yield _WORDS.get(hint, "a group of settings")
