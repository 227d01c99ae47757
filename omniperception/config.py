"""Configurations as text: compose, override, save and load."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra import compose as hydra_compose
from hydra import initialize, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from omniperception.common.checkpoints import list_checkpoints
from omnirobot.common.errors import ConfigError, UnknownKey, one_line, suggest
from omnirobot.common.files import write_whole
from omnirobot.common.shell import command_line

_SHIPPED = Path(__file__).resolve().parent / "conf"
CONFIG_DIR = _SHIPPED if _SHIPPED.is_dir() else _SHIPPED.parents[1] / "conf"
"""Presets: inside an installed package, at the top of a checkout."""
SHIPPED_RUNS = CONFIG_DIR.parent / "pretrained"
"""Published policies, likewise."""
CONFIG_FILE = "config.yaml"
RECIPE_FILE = "overrides.yaml"
"""In a run directory: the command line's overrides."""
OUTPUTS = Path("outputs")
SEARCH_PATH = "search_path"
"""Key of a configuration: the user's folders of presets, from `--config-dir` or `hydra.searchpath`."""
FIXED_BY_SCENARIO = ("seed", "terrain", "obstacles", "commands", "terminations")
"""Groups that a scenario replaces in a run's configuration; the run keeps all others."""
FIXED_BY_CONDITION = ("randomization", "condition")
"""Groups that a condition replaces, its own name and version among them."""
DEFINED_BY_SCENARIO = ("obstacles", "commands")
"""Groups that a scenario writes out in full, so that another preset would be mixed with it."""
SEVERAL_KEYS = {"scenario": FIXED_BY_SCENARIO, "condition": FIXED_BY_CONDITION, "family": ("families",)}
"""Keys of a configuration that these groups replace, where not the one of their own name."""
SUITES, STUDIES = "suite", "study"
"""Folders of what evaluate and ablate read; no groups of a configuration."""
_EXAMPLES = {"obstacles": "clearance=0.5", "commands": "speed=0.8"}
_PATHS = ("dir", "file", "files", "init", "path", "searchpath", "subdir", "teacher")
"""Last words of the keys whose values are paths."""


def _device_figure(name: str, figure: str) -> float:
    """A figure of a device, for `${device:...}` in presets."""
    from omnilidar import DEVICES

    if name not in DEVICES:
        raise ValueError(f"lidar.device={name} is unknown; known: {', '.join(DEVICES)}")
    return getattr(DEVICES[name], figure)


def _within(most: float, values: Sequence[float]) -> list[float]:
    """Values brought between -most and most, for `${within:1.0,${robot.gait.lin_vel_x}}` in presets."""
    return [min(max(value, -most), most) for value in _pair(values)]


def _pair(velocities: object) -> list[float]:
    """Least and most velocity of a robot's gait."""
    values = list(velocities) if isinstance(velocities, Sequence | ListConfig) else []
    if len(values) != 2 or not all(isinstance(value, int | float) for value in values):
        raise ValueError(
            f"lin_vel_x, lin_vel_y and ang_vel_z of the robot's gait must be [least, most], not {velocities}"
        )
    return values


def _by_speed(value: float, power: float, velocities: Sequence[float], reference: float) -> float:
    """What a preset has for a robot whose fastest velocity is `reference`, for one of these velocities: times their
    ratio to a power, so that errors count as shares of what is asked for.

    For `${by_speed:4.0,-2,${robot.gait.lin_vel_x},2.0}` in presets.
    """
    fastest = max(abs(velocity) for velocity in _pair(velocities))
    if fastest == 0:
        raise ValueError("lin_vel_x and ang_vel_z of the robot's gait must reach beyond 0, if only to 0.1")
    return value * (fastest / reference) ** power


OmegaConf.register_new_resolver("by_speed", _by_speed, replace=True)
OmegaConf.register_new_resolver("device", _device_figure, replace=True)
OmegaConf.register_new_resolver("within", _within, replace=True)


def compose(overrides: Sequence[str]) -> DictConfig:
    """Composes `conf/config.yaml` with overrides as on Hydra's command line.

    Raises:
        ConfigError: an override is wrong or fits nothing.
    """
    parsed = parse(overrides)
    folders = check(parsed)
    given = [str(o.input_line) for o in parsed if o.key_or_group != _SEARCHPATH]
    try:
        config = _composed([*given, *as_override(folders)])
    except _REFUSALS as error:
        raise _explained(error, parsed, folders) from None
    condition = config.hydra.runtime.choices.get("condition")
    with open_dict(config):
        del config["hydra"]
        if folders:
            config[SEARCH_PATH] = [str(folder) for folder in folders]
    return finish(config, condition)


def finish(config: DictConfig, condition: str | None) -> DictConfig:
    """A configuration that Hydra composed: a condition wins over what recipe and scenario say of the randomization."""
    if condition is not None:
        folders = [Path(folder) for folder in config.get(SEARCH_PATH) or ()]
        alone = _composed(["~experiment", f"condition={condition}", *as_override(folders)])
        config["randomization"] = alone["randomization"]
    _check_keys(config)
    config._set_flag(_COMPOSED, True)
    return config


_COMPOSED, _SEARCHPATH = "composed", "hydra.searchpath"
_REFUSALS = (HydraException, OmegaConfBaseException, ValueError)


def _composed(given: list[str]) -> DictConfig:
    with initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        return hydra_compose("config", given, return_hydra_config=True)


def is_composed(config: DictConfig) -> bool:
    """Tell whether a configuration is from `compose`: of presets and overrides, not from a run's file."""
    return bool(config._get_flag(_COMPOSED))


def load(run_dir: Path, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a run, changed by overrides in Hydra's grammar.

    obstacles=static replaces a whole group, dotted overrides single values; scenario=corridor replaces what
    FIXED_BY_SCENARIO names, condition=robot what FIXED_BY_CONDITION names. A run whose randomization is changed, or
    that is given ~condition, is under no condition.
    """
    config = read(run_dir)
    _check_keys(config)
    parsed = parse(overrides)
    folders = check(parsed, config)
    chosen = [o for o in parsed if _is_group(o, folders) or o.is_hydra_override()]
    groups = [str(o.input_line) for o in chosen if not (o.is_hydra_override() or o.is_delete())]
    fresh = compose([*groups, "~experiment", *as_override(folders)]) if groups else {}
    for override in chosen:
        group = override.key_or_group
        if group == _SEARCHPATH:
            continue
        if group == "experiment" or override.is_hydra_override():
            raise ConfigError(f"{override.input_line}: a run keeps its {group}; override the groups that should differ")
        if override.is_delete():
            config.pop(group, None)
            continue
        for key in SEVERAL_KEYS.get(group, (group,)):
            config[key] = fresh[key]
    if any(group_of(override) == "randomization" for override in parsed):
        config.pop("condition", None)
    if folders:
        config[SEARCH_PATH] = [str(folder) for folder in folders]
    OmegaConf.set_struct(config, True)
    values = [override for override in parsed if override not in chosen]
    if values:
        ConfigStore.instance().store("run", config)
        try:
            with initialize(config_path=None, version_base="1.3"):
                changed = hydra_compose("run", [str(override.input_line) for override in values])
        except _REFUSALS as error:
            raise _unknown(values, config) or ConfigError(one_line(error)) from None
        _check_keys(changed)
        return changed
    return config


def _keys() -> set[str]:
    """Keys at the top of a configuration."""
    groups = {path.name for path in CONFIG_DIR.iterdir() if path.is_dir()} - {SUITES, STUDIES}
    return {"seed", "num_envs", "distillation", "families", "init", "stepping", *groups}


def _check_keys(config: DictConfig) -> None:
    """Refuses what stands at the top of a configuration and nothing reads."""
    for key in config:
        if str(key) not in _keys() | {SEARCH_PATH}:
            raise UnknownKey(str(key), _keys())


def parse(overrides: Sequence[str], sweeps: bool = False) -> list[Override]:
    """Overrides by Hydra's grammar, in which = # ( [ , and others mean something; in a path they do not.

    Args:
        overrides: on a command line.
        sweeps: whether they may have several values, as with train -m.
    """
    parsed = [_parse_one(text, sweeps) for text in overrides]
    for override in parsed:
        if override.is_sweep_override() and not sweeps:
            raise ConfigError(f"{override.input_line} has several values, which only train -m runs; lists are [a,b]")
    return parsed


def _parse_one(text: str, sweeps: bool) -> Override:
    key, separator, value = text.partition("=")
    is_path = key.rpartition(".")[2].lstrip("+") in _PATHS and value != ""
    try:
        (override,) = OverridesParser.create().parse_overrides([text])
        several = override.is_sweep_override()
        is_text = sweeps if several else value == value.strip() and not isinstance(override.value(), bool | int | float)
        if is_text or not is_path:
            return override
    except HydraException:
        if not separator:
            raise ConfigError(f"'{text}' is not of the form key=value") from None
        if not is_path:
            raise ConfigError(
                f"{text}: a value is a number, a word, [a,b] or {{a:b}}; text with other signs is quoted, in a shell"
                f" {shlex.quote(f'{key}={quoted(value)}')}"
            ) from None
    return OverridesParser.create().parse_overrides([f"{key}={_quoted_path(value, sweeps)}"])[0]


def _quoted_path(value: str, several: bool) -> str:
    """A path, or several with commas between them, in Hydra's grammar."""
    if value[0] + value[-1] == "[]":
        return f"[{_quoted_path(value[1:-1], True)}]"
    return ",".join(quoted(os.path.expanduser(path)) for path in (value.split(",") if several else [value]))


def quoted(text: str) -> str:
    """Text as Hydra's grammar takes it, whatever signs it holds."""
    return QuotedString(text, Quote.double).with_quotes()


def jobs(parsed: Sequence[Override]) -> list[list[str]]:
    """The jobs of a sweep over every combination of values; none where a sweeper chooses values itself."""
    each = [
        [f"{o.get_key_element()}={value}" for value in (o.sweep_string_iterator() if o.is_discrete_sweep() else ())]
        if o.is_sweep_override()
        else [str(o.input_line)]
        for o in parsed
    ]
    return [list(job) for job in itertools.product(*each)]


def check(parsed: Sequence[Override], config: DictConfig | None = None) -> list[Path]:
    """Refuses overrides that Hydra would take and that contradict each other; the folders of presets of one's own.

    Args:
        parsed: the overrides.
        config: of a run, whose folders are searched as well.
    """
    folders = search_path(parsed, config)
    by_group = {o.key_or_group: o for o in parsed if _is_group(o, folders) and not o.is_delete()}
    for group, override in by_group.items():
        for name in _names(override):
            shipped, *others = (folder / group / f"{name}.yaml" for folder in (CONFIG_DIR, *folders))
            for own in others:
                if shipped.is_file() and own.is_file() and own.read_bytes() != shipped.read_bytes():
                    raise ConfigError(
                        f"{group}={name} comes with the package and would hide {own}; give yours another name"
                    )
    for group in DEFINED_BY_SCENARIO if "scenario" in by_group else ():
        if group in by_group:
            raise ConfigError(
                f"{by_group['scenario'].input_line} defines the {group}; leave {by_group[group].input_line} out, or"
                f" override single values such as {group}.{_EXAMPLES[group]}"
            )
    for override in parsed:
        given, condition = override.input_line, by_group.get("condition")
        if override.key_or_group.startswith("condition."):
            raise ConfigError(f"{given}: a condition is chosen as a whole, such as condition=robot")
        if condition and group_of(override) == "randomization":
            raise ConfigError(f"{condition.input_line} fixes the randomization; use ~condition or leave {given} out")
    return folders


def _is_group(override: Override, folders: Sequence[Path]) -> bool:
    """Tell whether an override chooses presets of a group."""
    return override.key_or_group not in (SUITES, STUDIES) and bool(presets(override.key_or_group, folders))


def _names(override: Override) -> list:
    """The presets that an override chooses."""
    value = override.value()
    return value if isinstance(value, list) else [value]


def _explained(error: BaseException, parsed: Sequence[Override], folders: Sequence[Path]) -> ConfigError:
    """What Hydra refuses, with what may have been meant."""
    chosen = [o for o in parsed if _is_group(o, folders)]
    for override in chosen:
        group, known = override.key_or_group, presets(override.key_or_group, folders)
        for name in () if override.is_delete() else _names(override):
            if not isinstance(name, str):
                hint = f"known: {', '.join(known)}; ~{group} leaves it out"
                return ConfigError(f"{override.input_line}: {group} names a preset; {hint}")
            if name not in known:
                hint = f"{suggest(name, known, and_all=True)}{_own(group, name)}"
                return ConfigError(f"{group}={name} is unknown; {hint}")
    with contextlib.suppress(*_REFUSALS):
        config = _composed([*(str(o.input_line) for o in chosen), *as_override(folders)])
        values = [o for o in parsed if o not in chosen and not o.is_hydra_override()]
        return _unknown(values, config) or ConfigError(one_line(error))
    return ConfigError(one_line(error))


def _unknown(overrides: Sequence[Override], config: DictConfig) -> ConfigError | None:
    """What to say of the first override whose key a configuration has not."""
    for override in overrides:
        node: Any = config
        text, names = str(override.input_line), override.key_or_group.split(".")
        for depth, name in enumerate(names if not (override.is_add() or override.is_force_add()) else ()):
            if isinstance(node, ListConfig) and name.isdecimal() and int(name) < len(node):
                node = node[int(name)]
            elif not isinstance(node, DictConfig):
                return ConfigError(f"{text} is unknown; {'.'.join(names[:depth])} is {node}")
            elif name in node:
                node = OmegaConf.select(node, name)
            elif depth == 0:
                return UnknownKey(text, _keys(), name)
            else:
                error = str(UnknownKey(text, map(str, node), name))
                hint = f"{' A' if error.endswith('?') else '; a'} key that is left at its default is added: +{text}"
                return ConfigError(error if override.is_delete() else f"{error}{hint}")
    return None


def group_of(override: Override) -> str:
    """The key at the top of the configuration that an override changes."""
    return override.key_or_group.partition(".")[0]


def _own(group: str, name: str) -> str:
    """What finds a preset of the user's own, where it lies in conf/ of the working directory; else nothing."""
    found = Path("conf", group, f"{name}.yaml").is_file()
    return "; presets of your own are found with --config-dir conf" if found else ""


def search_path(overrides: Sequence[Override | str], config: DictConfig | None = None) -> list[Path]:
    """The user's folders of presets: those saved with a run, and those that hydra.searchpath names."""
    remembered = config.get(SEARCH_PATH) or () if config is not None else ()
    found = [Path(name) for name in remembered if Path(name).is_dir()]
    for given in overrides:
        if isinstance(given, str) and not given.startswith("hydra.searchpath="):
            continue
        override = parse([given])[0] if isinstance(given, str) else given
        if override.key_or_group == "hydra.searchpath":
            value = override.value()
            found += [_folder(str(entry)) for entry in (value if isinstance(value, list) else [value])]
    return list(dict.fromkeys(found))


def _folder(entry: str) -> Path:
    """The folder that an entry of Hydra's search path names."""
    if entry.startswith("pkg://"):
        with contextlib.suppress(ImportError):
            spec = importlib.util.find_spec(entry.removeprefix("pkg://").replace("/", "."))
            for location in (spec and spec.submodule_search_locations) or ():
                return Path(location)
        raise ConfigError(f"hydra.searchpath: there is no package {entry.removeprefix('pkg://')}")
    folder = Path(entry.removeprefix("file://")).resolve()
    if not folder.is_dir():
        raise ConfigError(f"hydra.searchpath: {folder} is not a folder")
    return folder


def as_override(folders: Sequence[Path]) -> list[str]:
    """The override that puts folders on Hydra's search path."""
    return [f"hydra.searchpath=[{','.join(quoted(f'file://{folder}') for folder in folders)}]"] if folders else []


def presets(group: str, folders: Sequence[Path] = ()) -> tuple[str, ...]:
    """Names of a group's presets, those in the user's folders included; none where there is no such group."""
    found = {path.stem for folder in (CONFIG_DIR, *folders) for path in (folder / group).glob("[!_]*.yaml")}
    return tuple(sorted(found))


def listed(folder: str, name: str, folders: Sequence[Path] = ()) -> Path:
    """The file of a suite or study, which one of the user's folders may replace.

    Raises:
        ConfigError: there is none of that name.
    """
    known = presets(folder, folders)
    if name not in known:
        raise ConfigError(f"{folder}={name} is unknown; {suggest(name, known)}{_own(folder, name)}")
    paths = (parent / folder / f"{name}.yaml" for parent in (*folders, CONFIG_DIR))
    return next(path for path in paths if path.is_file())


def save(composed: dict, run_dir: Path) -> None:
    """Writes the resolved configuration into the run directory."""
    run_dir.mkdir(parents=True, exist_ok=True)
    write_whole(run_dir / CONFIG_FILE, as_yaml(composed).encode())


def save_recipe(overrides: Sequence[str], run_dir: Path) -> None:
    """Writes the overrides that a run was begun with beside its configuration."""
    write_whole(run_dir / RECIPE_FILE, yaml.safe_dump(list(overrides)).encode())


def read_recipe(run_dir: Path) -> list[str]:
    """The overrides that a run was begun and went on with; none where it was begun before they were kept."""
    path = run_dir / RECIPE_FILE
    if not path.is_file():
        return []
    try:
        overrides = yaml.safe_load(path.read_text()) or []
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{path} holds no overrides: {one_line(error)}") from None
    if not isinstance(overrides, list) or not all(isinstance(text, str) for text in overrides):
        raise ConfigError(f"{path} holds no overrides, a list of texts")
    return overrides


def recipe(run_dir: Path) -> str | None:
    """Those overrides in one line, but for where it is; None: it was begun before they were kept."""
    if not (run_dir / RECIPE_FILE).is_file():
        return None
    return " ".join(text for text in read_recipe(run_dir) if not text.startswith("hydra."))


def as_yaml(composed: dict) -> str:
    """A resolved configuration as it is saved."""
    return yaml.safe_dump(composed, sort_keys=False)


def read(run_dir: Path) -> DictConfig:
    """The configuration that a run directory holds."""
    path = run_dir / CONFIG_FILE
    if not path.is_file():
        raise ConfigError(f"{run_dir} is not a run directory: it has no {CONFIG_FILE}; run=latest finds the newest run")
    try:
        config = OmegaConf.load(path)
    except (yaml.YAMLError, OmegaConfBaseException, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{path} is not a configuration: {one_line(error)}") from None
    if not isinstance(config, DictConfig) or not config:
        raise ConfigError(f"{path} is not a configuration; give another run directory")
    return config


def is_begun(run_dir: Path, composed: dict) -> bool:
    """Tell whether `run_dir` holds a run of exactly this configuration; one of another is a ConfigError.

    What has no checkpoint has not begun: a training that failed, or was stopped, before its first.
    """
    path = run_dir / CONFIG_FILE
    if not path.is_file() or not list_checkpoints(run_dir):
        return False
    read(run_dir)  # a damaged one is refused
    saved = yaml.safe_load(path.read_text())
    if saved != yaml.safe_load(yaml.safe_dump(composed)):
        from omniperception.schema import words_of  # brings PyTorch, which what lists runs does without

        line = command_line("train", *words_of(run_dir, saved))
        raise ConfigError(
            f"{run_dir} holds a run of another configuration; choose another hydra.run.dir, or go on with it: {line}"
        )
    return True


def find_run(name: str, key: str = "run") -> Path:
    """The run directory that `run=...`, or another key, names: a path, or `latest` for the newest under outputs/.

    Outside a checkout, too, pretrained/avoider and its like are those that come with the package.
    """
    if name != "latest":
        path = Path(os.path.expanduser(name))
        if not path.is_dir() and path.parts[:1] == (SHIPPED_RUNS.name,):
            path = SHIPPED_RUNS.parent / path
        if not path.is_dir():
            raise ConfigError(f"{key}={name} does not exist; give a run directory or {key}=latest")
        return path
    runs = [run for run in find_runs(OUTPUTS) if list_checkpoints(run)]
    if not runs:
        raise ConfigError(f"{key}=latest finds no run with a checkpoint under outputs/; train one first")
    return runs[-1]


def find_runs(folder: Path) -> list[Path]:
    """Run directories in a folder, the newest last."""
    found = sorted(folder.glob(f"**/{CONFIG_FILE}"), key=lambda path: path.stat().st_mtime)
    return [path.parent for path in found]
