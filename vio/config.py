"""The configuration: nested frozen dataclasses, filled from defaults < file < `--set a.b=c`, strictly checked.

YAML files hold deviations only. An unknown key or a wrong type is an error that names the file, the key and the
nearest valid key.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import yaml

from vio.datasets.settings import DatasetSettings
from vio.errors import ConfigError
from vio.filters.settings import MsckfSettings, VislamSettings
from vio.frontend_package import frontend_module
from vio.selectors import SelectorSettings
from vio.setting import Range, Section, setting

if TYPE_CHECKING:
    from frontend.settings import FrontendSettings
else:
    FrontendSettings = frontend_module("settings").FrontendSettings

BackendName = Literal["vislam", "msckf"]
MotionName = Literal["auto", "imu", "velocity", "none"]

_Section = TypeVar("_Section")


@dataclass(frozen=True, slots=True)
class Config(Section):
    """Every setting of a run."""

    motion: MotionName = setting(
        "auto",
        "motion input for propagation: imu, velocity, none (images alone), or auto: the best that the recording "
        "contains and the back end supports (an observation log: what its run used)",
    )
    backend: BackendName = setting(
        "msckf", "the estimator: msckf, the sliding-window filter, or vislam, the paper's filter"
    )
    lag_frames: int = setting(
        0,
        "output each pose this many frames late, smoothed by the window (msckf, up to its clones); 0: causal",
        at_least=0,
    )
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    frontend: FrontendSettings = field(default_factory=FrontendSettings)
    selector: SelectorSettings = field(default_factory=SelectorSettings)
    vislam: VislamSettings = field(default_factory=VislamSettings)
    msckf: MsckfSettings = field(default_factory=MsckfSettings)


def load_config(path: Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Build the configuration from the defaults, a YAML file and `a.b=value` overrides, in that order.

    Raises:
        ConfigError: the file cannot be read, or a key or value is wrong.
    """
    config = Config()
    if path is not None:
        config = merge(config, _read_yaml(path), where=str(path))
    for override in overrides:
        config = merge_override(config, override, example="selector.name=grid")
    return config


def merge_override(section: _Section, override: str, *, example: str) -> _Section:
    """Return a copy of a section with one setting replaced, given as `a.b=value` as after `--set`.

    Raises:
        ConfigError: the text is no such pair (the message gives the example), or a key or value is wrong.
    """
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set takes key=value, got '{override}'; for example --set {example}")
    try:
        nested: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {override}: the value is not valid YAML ({_first_line(error)})") from error
    for part in reversed(key.strip().split(".")):
        nested = {part: nested}
    return merge(section, nested, where=f"--set {override}")


def merge(section: _Section, values: Mapping[str, Any], *, where: str, prefix: str = "", root: Any = None) -> _Section:
    """Return a copy of a section with some settings replaced.

    Args:
        section: a dataclass instance.
        values: deviations, nested by section.
        where: the source of the values, for messages.
        prefix: the path of the section, ending in a dot, for messages.
        root: the configuration that contains the section, for messages; None: the section itself.

    Raises:
        ConfigError: a key is unknown, or a value has the wrong type or is out of range.
    """
    hints = get_type_hints(type(section))
    root = section if root is None else root
    names = [f.name for f in fields(section)]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        path = f"{prefix}{key}"
        if key not in names:
            raise ConfigError(f"{where}: unknown setting '{path}'{_suggestion(str(key), names, prefix, root)}")
        current = getattr(section, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(
                    f"{where}: '{path}' is a section; give its settings, such as {path}.{_first(current)}"
                )
            changes[key] = merge(current, value, where=where, prefix=f"{path}.", root=root)
        else:
            changes[key] = _checked(value, hints[key], path, where)
    try:
        return dataclasses.replace(section, **changes)  # type: ignore[type-var]
    except ConfigError as error:  # a value out of range
        raise ConfigError(f"{where}: {error}") from error


def as_dict(section: Any) -> dict[str, Any]:
    """Turn a configuration into nested plain dictionaries that YAML can hold."""
    return {
        f.name: as_dict(value) if is_dataclass(value := getattr(section, f.name)) else _plain(value)
        for f in fields(section)
    }


def to_yaml(config: Config) -> str:
    """Return the effective configuration as YAML; `load_config` reads it back to an equal one."""
    return yaml.safe_dump(as_dict(config), sort_keys=False, allow_unicode=True)


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """One row of `vio config --show`."""

    key: str
    default: Any
    unit: str
    choices: tuple[str, ...]
    range: str  # "at least 3", "above 0 and below 1", …; empty: any number
    doc: str


def describe(section: Any, prefix: str = "") -> Iterator[SettingInfo]:
    """Yield every setting with its default, unit and meaning."""
    hints = get_type_hints(type(section))
    for f in fields(section):
        value = getattr(section, f.name)
        if is_dataclass(value):
            yield from describe(value, f"{prefix}{f.name}.")
        else:
            hint = hints[f.name]
            choices = tuple(map(str, get_args(hint))) if get_origin(hint) is Literal else ()
            unit, doc = f.metadata.get("unit", ""), f.metadata.get("doc", "")
            yield SettingInfo(f"{prefix}{f.name}", value, unit, choices, str(f.metadata.get("range", Range())), doc)


class _StrictLoader(yaml.SafeLoader):
    """YAML loader that rejects duplicate keys, of which YAML itself would use the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Reject a duplicate key."""
        seen: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the configuration is not UTF-8 text") from error
    try:
        values = yaml.load(text, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML ({_first_line(error)})") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: a configuration is a mapping of settings, not a {type(values).__name__}")
    return values


def _checked(value: Any, hint: Any, path: str, where: str) -> Any:
    """Return the value in the type that the setting declares, or raise."""
    origin = get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        members = [member for member in get_args(hint) if member is not type(None)]
        return _checked(value, members[0], path, where)
    if origin is Literal:
        choices = get_args(hint)
        if value in choices and type(value) in {type(c) for c in choices}:
            return value
        hint_text = (
            f"; did you mean '{near[0]}'?" if (near := difflib.get_close_matches(str(value), choices, 1)) else ""
        )
        raise ConfigError(f"{where}: {path} is one of {', '.join(choices)}, not {value!r}{hint_text}")
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(value, hint) and not (isinstance(value, bool) and hint is not bool):
        if hint is float and value != value:
            raise ConfigError(f"{where}: {path} must be a number, got nan")
        return value
    raise ConfigError(f"{where}: {path} takes {_type_name(hint)}, got {value!r}{_number_hint(value, hint)}")


def _number_hint(value: Any, hint: Any) -> str:
    if hint is float and isinstance(value, str):
        try:
            return f" (to YAML 1.1 this is text; write {float(value)!r} with a decimal point)"
        except ValueError:
            return ""
    return ""


def _type_name(hint: Any) -> str:
    return {float: "a number", int: "a whole number", bool: "true or false", str: "text", Path: "a path"}.get(
        hint, str(hint)
    )


def _suggestion(key: str, names: Sequence[str], prefix: str, root: Any) -> str:
    """Suggest a setting: the same name in a sibling section, a similar one here, or the same name anywhere.

    A name may be split over section and setting: `consensus_samples` is `consensus.samples`.
    """
    same_name = [row.key for row in describe(root) if f".{row.key}".replace(".", "_").endswith(f"_{key}")]
    siblings = [name for name in same_name if name.startswith(prefix[: prefix.find(".") + 1])]
    similar = [prefix + name for name in difflib.get_close_matches(key, names, 1, cutoff=0.4)]
    for found in (siblings, similar, same_name):
        if found:
            return f"; did you mean '{found[0]}'?"
    return f"; valid here: {', '.join(prefix + name for name in names)}"


def _first(section: Any) -> str:
    return fields(section)[0].name


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())
