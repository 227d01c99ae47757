"""Configurations as objects: finds what names stand for, checks keys and values, and builds dataclasses of them.

A name, such as a reward's or a network's, stands for a function or class of this package: `NAMES` lists all of them. A
dotted path, such as `my_project.rewards.power`, stands for one of the user's own, if the user trusts it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import math
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml

from omniperception.common.checked import expected
from omniperception.env.mdp.terms import RewardTerm
from omnirobot.common.errors import ConfigError, DoesNotFit, UnknownKey, suggest

ANYTHING = None
"""As `trust`: everything that can be imported."""


@dataclass(frozen=True)
class Kind:
    """Names allowed at one place of a configuration.

    Attributes:
        names: path of a function or class by name; or the path of a module, whose public functions and classes are
            meant by their own names.
        tag: the key that holds the name. Without it the name is the node's own key.
        built: whether it is called at once; otherwise it is left to the caller, with its parameters.
        given: number of arguments that the caller adds; None: any.
    """

    names: Mapping[str, str] | str
    tag: str = "type"
    built: bool = True
    given: int | None = 0


def _members(module: str, **names: str) -> dict[str, str]:
    return {name: f"omniperception.{module}.{member}" for name, member in names.items()}


_PATTERNS = "airy avia custom grid hap hdl32e hdl64e height_scanner horizon mid360 mid40 mid70 os0 os1 os2 spinning"
_PATTERNS += " mid360_measured tele15 unitree_l1 unitree_l2 vlp16 vlp32c xt16 xt32"

NAMES: dict[str, Kind] = {
    "rewards.terms.*": Kind("omniperception.env.mdp.rewards", "func", built=False, given=1),
    "observations.groups.*.terms.*": Kind("omniperception.env.mdp.observations", "func", built=False, given=1),
    "commands": Kind(_members("env.mdp.commands", velocity="VelocityCommandConfig", goal="GoalCommandConfig")),
    "terrain": Kind(
        _members("scene.terrain", flat="TerrainConfig")
        | _members("scene.tiled_terrain", tiled="TiledTerrainConfig")
        | _members("scene.map_terrain", heights="HeightMapConfig", plan="FloorPlanConfig", place="PlaceConfig")
    ),
    "terrain.tiles.*": Kind(_members("scene.tiles", rough="Rough", slope="Slope", stairs="Stairs", stones="Stones")),
    "obstacles.groups.*.layout": Kind(
        _members("scene.layouts.maze", maze="MazeLayout")
        | _members("scene.layouts.corridor", corridor="CorridorLayout")
        | _members("scene.layouts.blocks", blocks="BlocksLayout")
        | _members("scene.layouts.barn", barn="BarnLayout")
    ),
    "sim": Kind(
        _members("sim.mujoco", mujoco="SimConfig")
        | _members("sim.mujoco_warp", mujoco_warp="MujocoWarpConfig")
        | _members("sim.planar", planar="PlanarConfig")
    ),
    "logger": Kind(
        _members("learning.log_writers", tensorboard="LoggerConfig", wandb="WandbConfig", mlflow="MlflowConfig")
        | _members("learning.log_writers", trackio="TrackioConfig")
    ),
    "lidar.consumers.*": Kind("omniperception.env.consumers", built=False),
    "lidar.pattern": Kind({name: f"omnilidar.{name}" for name in _PATTERNS.split()}, built=False),
    "perception.sampler": Kind(
        _members("perception", raw="RawSampler", fps="FpsSampler", pd="PdSampler", proximity="ProximitySampler")
        | _members("perception", standing="StandingSampler"),
        built=False,
    ),
    "perception.network": Kind(
        _members("perception", direct_mlp="DirectMlp", fps_mlp="FpsMlp", fps_gru="FpsGru", pd_risknet="PdRiskNet")
        | _members("perception", proximity_gru="ProximityGru", polar_rings="PolarRings"),
        built=False,
        given=None,
    ),
    "perception.network.rings": Kind(_members("perception", rings="RingPath"), built=False, given=None),
    "ppo.phases.*": Kind({}, built=False, given=None),
}
"""Names allowed, by key; `*` is any one name."""

_UNBOUNDED = ("lidar.max_range", "lidar.motion_jump", "rewards.terms.*.most")
"""Keys that may be infinite; none may be NaN."""


def make(hint: Any, value: object, key: str, trust: Sequence[str] | None = ()) -> Any:
    """Builds the object of a value of a configuration.

    Args:
        hint: its type, as annotated; a mapping becomes a dataclass, or what it names.
        value: plain data. In a mapping of objects null leaves one out.
        key: where it stands, such as `lidar` or `rewards.terms.alive`.
        trust: modules of the user's own that dotted paths may name, with what is below them; ANYTHING: all.

    Raises:
        ConfigError: one line with the key, what was given and what was expected.
    """
    kind = _kind(key)
    if isinstance(value, Mapping) and kind is not None:
        return _named(kind, hint, dict(value), key, trust)
    options = [option for option in _options(hint) if option is not types.NoneType]
    if isinstance(value, Mapping):
        for option in options:
            if typing.get_origin(option) in (Mapping, dict):
                item_hint = typing.get_args(option)[1]
                given = {name: item for name, item in value.items() if item is not None}
                items = {name: make(item_hint, item, f"{key}.{name}", trust) for name, item in given.items()}
                return {name: item for name, item in items.items() if item is not None}
            if isinstance(option, type) and dataclasses.is_dataclass(option):
                return call(option, arguments(option, value, key, trust), key)
    if not _fits(value, hint):
        raise DoesNotFit(f"{key}={_shown(value)} must {expected(hint, kinds=True)}")
    if not _is_finite(value, any(fnmatchcase(key, place) for place in _UNBOUNDED)):
        raise DoesNotFit(f"{key}={_shown(value)} must be finite")
    return tuple(make(Any, item, key, trust) for item in value) if isinstance(value, list) else value


def arguments(
    target: Callable,
    values: Mapping[str, object],
    key: str,
    trust: Sequence[str] | None = (),
    given: int | None = 0,
    others: Sequence[str] = (),
) -> dict[str, Any]:
    """Keyword arguments of a function or class from plain data, checked against its signature.

    Args:
        target: a function, or a class.
        values: by name.
        key: where they stand.
        trust: see `make`.
        given: number of leading arguments that the caller adds; None: any, and none counts as missing.
        others: keys that stand beside them, for suggestions.
    """
    parameters = list(inspect.signature(target).parameters.values())[given or 0 :]
    named = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        for name in values:
            if name not in named:
                raise UnknownKey(f"{key}.{name}", (*named, *others))
    missing = [p.name for p in parameters if p.default is p.empty and p.name in named and p.name not in values]
    if missing and given is not None:
        raise DoesNotFit(f"{key} lacks {', '.join(missing)}: give {key}.{missing[0]}=...")
    hints = types_of(target)
    return {name: make(hints.get(name, Any), item, f"{key}.{name}", trust) for name, item in values.items()}


def call(target: Callable, keywords: Mapping[str, Any], key: str) -> Any:
    """Calls a dataclass or function; a value that it refuses is a ConfigError that begins with the key."""
    try:
        return target(**keywords)
    except (TypeError, ValueError, OSError, ImportError) as error:
        root, text = key.partition(".")[0], str(error)
        named = text.startswith(root) and not text.startswith(f"{root}: ")
        raise ConfigError(text if named else f"{key}: {text.removeprefix(f'{root}: ')}") from None


def look_up(kind: Kind, name: str, key: str, trust: Sequence[str] | None = ()) -> Callable:
    """Resolves a name or a dotted path to a function or class.

    Args:
        kind: what may be named there.
        name: one of its names, or a dotted path.
        key: of the name, for errors.
        trust: see `make`.
    """
    names = _names(kind)
    if name in names or name in names.values():
        return _imported(names.get(name, name), key)
    if "." not in name:
        is_key = key.endswith(f".{name}")
        given, before = (key, key.removesuffix(name)) if is_key else (f"{key}={name}", "")
        hint = suggest(name, tuple(names), before)
        raise DoesNotFit(f"{given} is unknown; {hint}, or {kind.tag}: a dotted path to your own")
    if trust is not ANYTHING and not any(name.startswith(f"{prefix}.") for prefix in trust):
        raise ConfigError(
            f"{key}={name} is not built: a run's file names it, and it is outside of this package; if you trust it, add"
            f" trust={','.join((*trust, name.partition('.')[0]))}"
        )
    return _imported(name, key)


def _named(kind: Kind, hint: Any, values: dict[str, object], key: str, trust: Sequence[str] | None) -> Any:
    """Object that a mapping names, with its parameters: called, or left to be called."""
    names, own = _names(kind), key.rpartition(".")[2]
    if len(names) == 1:
        own = next(iter(names))
    name = values.pop(kind.tag, own)
    if not isinstance(name, str):
        raise DoesNotFit(f"{key}.{kind.tag}={_shown(name)} must be text")
    if name == own not in names and key in NAMES:
        raise DoesNotFit(f"{key} lacks its {kind.tag}: give {key}.{kind.tag}=..., one of {', '.join(names)}")
    target = look_up(kind, name, key if name == own else f"{key}.{kind.tag}", trust)
    if hint is RewardTerm:
        return _reward(kind, target, values, key, trust)
    given = 0 if kind.given == 1 and inspect.isclass(target) else kind.given
    keywords = arguments(target, values, key, trust, given, (kind.tag,))
    return call(target, keywords, key) if kind.built else _bound(target, keywords)


def _reward(kind: Kind, target: Callable, values: dict[str, object], key: str, trust: Sequence[str] | None) -> Any:
    """A weighted term; None where its weight is 0 or null."""
    if "weight" not in values:
        raise DoesNotFit(f"{key} lacks its weight: give {key}.weight=...")
    weight = make(float | None, values.pop("weight"), f"{key}.weight")
    if not weight:
        return None
    given = 0 if inspect.isclass(target) else kind.given
    return RewardTerm(weight, _bound(target, arguments(target, values, key, trust, given, (kind.tag, "weight"))))


def _bound(target: Callable, keywords: dict[str, Any]) -> Callable:
    return partial(target, **keywords) if keywords else target


def packages_of_own(composed: Mapping[str, Any], key: str = "") -> set[str]:
    """Packages of the user's own that a configuration names, as `trust` takes them."""
    found = set()
    for name, value in composed.items():
        path = f"{key}.{name}" if key else str(name)
        if isinstance(value, Mapping):
            kind = _kind(path)
            named = value.get(kind.tag) if kind else None
            if kind and isinstance(named, str) and "." in named and named not in _names(kind).values():
                found.add(named.partition(".")[0])
            found |= packages_of_own(value, path)
    return found


def words_of(run_dir: Path, composed: Mapping[str, Any]) -> list[str]:
    """`run=` of a command line that reads this run, with the `trust=` that its configuration needs."""
    own = sorted(packages_of_own(composed))
    return [f"run={run_dir}", *([f"trust={','.join(own)}"] if own else [])]


def _kind(key: str) -> Kind | None:
    depth = key.count(".")
    found = (kind for place, kind in NAMES.items() if place.count(".") == depth and fnmatchcase(key, place))
    return next(found, None)


@cache
def _public(module: str) -> dict[str, str]:
    """Path of every function and class that a module defines and does not hide."""
    members = vars(importlib.import_module(module)).items()
    own = [name for name, member in members if callable(member) and getattr(member, "__module__", None) == module]
    return {name: f"{module}.{name}" for name in own if not name.startswith("_")}


def _names(kind: Kind) -> Mapping[str, str]:
    return _public(kind.names) if isinstance(kind.names, str) else kind.names


def _imported(path: str, key: str) -> Callable:
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except (ImportError, TypeError, ValueError) as error:
        hint = "; PYTHONPATH=. has this folder searched" if isinstance(error, ModuleNotFoundError) else ""
        raise ConfigError(f"{key}={path} cannot be imported: {error}{hint}") from None
    if not callable(found):
        raise ConfigError(f"{key}={path}: {module} has no function or class {name}")
    return found


@cache
def types_of(target: Callable) -> dict[str, Any]:
    """Types of the parameters of a function, or fields of a class, but for those that only type checkers import."""
    sources: Sequence[Any] = [target]
    if inspect.isclass(target):
        sources = target.__mro__[::-1] if dataclasses.is_dataclass(target) else [target.__init__]
    hints = {}
    for source in sources:
        names = vars(sys.modules[source.__module__])
        for name, hint in getattr(source, "__annotations__", {}).items():
            with contextlib.suppress(NameError):
                hints[name] = eval(hint, names) if isinstance(hint, str) else hint
    return hints


def _options(hint: Any) -> Sequence[Any]:
    """Members of a union, or the type alone, without bounds."""
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _fits(value: object, hint: Any) -> bool:
    """Tell whether plain data that is no mapping may stand for a type."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _fits(value, args[0])
    if hint is Any or isinstance(hint, typing.TypeVar):
        return not isinstance(value, Mapping)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in args)
    if origin is typing.Literal:
        return value in args
    if hint is types.NoneType:
        return value is None
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    if origin in (tuple, list, Sequence):
        if not isinstance(value, (list, tuple)):
            return False
        hints = list(args) if origin is tuple and args[-1] is not Ellipsis else [args[0]] * len(value)
        return len(value) == len(hints) and all(map(_fits, value, hints))
    return hint in (bool, str) and isinstance(value, hint)


def _is_finite(value: object, or_infinite: bool) -> bool:
    """Tell whether no number of a value is NaN, nor, unless it may be, infinite."""
    if isinstance(value, (list, tuple)):
        return all(_is_finite(item, or_infinite) for item in value)
    return not isinstance(value, float) or math.isfinite(value) or (or_infinite and math.isinf(value))


def _shown(value: object) -> str:
    """A value as it is written on a command line."""
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
