"""Configurations as text: compose, check, save and load."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

CONFIG_DIR = Path(__file__).resolve().parents[1] / "conf"
CONFIG_FILE = "config.yaml"
OUTPUTS = Path("outputs")
FIXED_BY_SCENARIO = ("seed", "terrain", "obstacles", "commands", "terminations", "randomization")
"""What a scenario replaces in a run's configuration; the run keeps everything else."""
DEFINED_BY_SCENARIO = ("obstacles", "commands")
"""Groups that a scenario writes out in full, so that another preset would be mixed with it."""


class ConfigError(ValueError):
    """A configuration that cannot run; the message is one line that says what to change."""


def compose(overrides: Sequence[str]) -> DictConfig:
    """Composes `conf/config.yaml` with overrides as on the command line."""
    _check_scenario(overrides)
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
            config = hydra_compose("config", overrides=list(overrides))
            presets = hydra_compose("config", overrides=[o for o in overrides if _is_group(o)])
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(one_line(error)) from None
    _check_kinds(config, presets)
    return config


def save(composed: dict, run_dir: Path) -> None:
    """Writes the resolved configuration into the run directory."""
    run_dir.mkdir(parents=True, exist_ok=True)
    (run_dir / CONFIG_FILE).write_text(yaml.safe_dump(composed, sort_keys=False))


def is_begun(run_dir: Path, composed: dict) -> bool:
    """Whether `run_dir` holds a run of exactly this configuration; one of another is a ConfigError."""
    path = run_dir / CONFIG_FILE
    if not path.is_file():
        return False
    if yaml.safe_load(path.read_text()) != yaml.safe_load(yaml.safe_dump(composed)):
        raise ConfigError(
            f"{run_dir} holds a run of another configuration; go on with it by python train.py run={run_dir}, or choose"
            " another hydra.run.dir"
        )
    return True


def load(run_dir: Path, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a run, changed by overrides.

    obstacles=static replaces a whole group, dotted overrides single values, and scenario=corridor replaces what
    FIXED_BY_SCENARIO names.
    """
    path = run_dir / CONFIG_FILE
    if not path.is_file():
        raise ConfigError(f"{run_dir} is not a run directory: it has no {CONFIG_FILE}; run=latest finds the newest run")
    config = OmegaConf.load(path)
    groups = [o for o in overrides if _is_group(o)]
    if groups:
        fresh = compose(groups)
        for override in groups:
            group = override.split("=", 1)[0]
            if group == "experiment":
                raise ConfigError(f"{override}: a run keeps its experiment; override the groups that should differ")
            for key in FIXED_BY_SCENARIO if group == "scenario" else (group,):
                config[key] = fresh[key]
    for override in overrides:
        if override not in groups:
            _set(config, override)
    return config


def scenarios() -> tuple[str, ...]:
    """Names of the scenarios in conf/scenario."""
    return tuple(sorted(path.stem for path in (CONFIG_DIR / "scenario").glob("*.yaml")))


def find_run(name: str, key: str = "run") -> Path:
    """The run directory that `run=...`, or another key, names: a path, or `latest` for the newest under outputs/."""
    if name != "latest":
        path = Path(name)
        if not path.is_dir():
            raise ConfigError(f"{key}={name} does not exist; give a run directory or {key}=latest")
        return path
    runs = sorted(OUTPUTS.glob(f"**/{CONFIG_FILE}"), key=lambda path: path.stat().st_mtime)
    if not runs:
        raise ConfigError(f"{key}=latest finds no run under outputs/; train one with python train.py first")
    return runs[-1].parent


def split_arguments(arguments: Sequence[str], known: dict[str, str]) -> tuple[dict[str, str], list[str]]:
    """Takes an entry point's own `key=value` arguments (with defaults) out of a list of overrides."""
    own, overrides = dict(known), []
    for argument in arguments:
        key, separator, value = argument.partition("=")
        if not separator and not argument.startswith("-"):
            raise ConfigError(f"argument '{argument}' is not of the form key=value")
        if key in own:
            own[key] = value
        else:
            overrides.append(argument)
    return own, overrides


def positive(key: str, text: str, kind: type) -> float:
    """The positive number, int or float, that an entry point's own argument stands for."""
    try:
        value = kind(text)
    except ValueError:
        value = 0
    if not 0 < value < float("inf"):
        raise ConfigError(f"{key}={text} must be a positive {'whole ' if kind is int else ''}number")
    return value


@contextlib.contextmanager
def one_line_errors(*also: type[Exception]) -> Iterator[None]:
    """Turns a wrong configuration, or one of `also`, into one line on standard error and exit code 2."""
    try:
        yield
    except (ConfigError, *also) as error:
        print(f"error: {one_line(error)}", file=sys.stderr, flush=True)
        sys.exit(2)


def _check_scenario(overrides: Sequence[str]) -> None:
    chosen = dict(override.split("=", 1) for override in overrides if "=" in override)
    if "scenario" not in chosen:
        return
    for group in DEFINED_BY_SCENARIO:
        if group in chosen:
            raise ConfigError(
                f"scenario={chosen['scenario']} defines the {group}; leave {group}={chosen[group]} out, or override"
                f" single values such as {group}.{_EXAMPLES[group]}"
            )


_EXAMPLES = {"obstacles": "clearance=0.5", "commands": "speed=0.8"}


def _is_group(override: str) -> bool:
    """Whether an override chooses a preset, such as obstacles=static."""
    return (CONFIG_DIR / override.split("=", 1)[0]).is_dir()


_ONE_OR_SEVERAL = ("init",)
"""Keys that take a name or a list of names, whichever the preset has; `_names` checks them."""


def _check_kinds(config: object, presets: object, key: str = "") -> None:
    """Every value must be of the kind that its preset has: a number for a number, a list for a list."""
    if isinstance(config, DictConfig) and isinstance(presets, DictConfig):
        for name in presets:
            path = f"{key}.{name}" if key else str(name)
            if name in config and path not in _ONE_OR_SEVERAL and not OmegaConf.is_interpolation(presets, name):
                _check_kinds(config[name], presets[name], path)
        return
    given, expected = _kind(config), _kind(presets)
    if None in (given, expected) or given == expected or (given, expected) == ("a whole number", "a number"):
        return
    raise ConfigError(f"{key}={config} must be {expected}")


def _kind(value: object) -> str | None:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    kinds |= {ListConfig: "a list", DictConfig: "a group of settings"}
    return kinds.get(type(value))


def _set(config: DictConfig, override: str) -> None:
    key, separator, value = override.partition("=")
    if not separator:
        raise ConfigError(f"argument '{override}' is not of the form key=value")
    if OmegaConf.select(config, key, default=_MISSING) is _MISSING:
        parent = OmegaConf.select(config, key.rpartition(".")[0]) if "." in key else config
        known = ", ".join(map(str, parent)) if isinstance(parent, DictConfig) else "nothing"
        raise ConfigError(f"unknown override '{override}'; known there: {known}")
    before = OmegaConf.select(config, key)
    OmegaConf.update(config, key, yaml.safe_load(value))
    _check_kinds(OmegaConf.select(config, key), before, key)


_MISSING = object()


def one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines) or type(error).__name__
