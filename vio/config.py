"""The configuration: nested frozen dataclasses, filled from defaults < file < `--set a.b=c`,
strictly checked.

YAML files hold deviations only. An unknown key or a wrong type is an error that names the file, the
key and the nearest valid key.
"""

from __future__ import annotations

import dataclasses
import difflib
import logging
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import yaml

from vio.dataclass import dataclass
from vio.datasets.settings import DatasetSettings
from vio.errors import ConfigError
from vio.files.inputs import read_input
from vio.files.yaml_text import MAX_BYTES, read_yaml
from vio.filters import BACKENDS
from vio.filters.settings import MsckfSettings, VislamSettings
from vio.frontend.settings import FrontendSettings
from vio.imu.settings import ImuSettings
from vio.selection.selectors import SelectorSettings
from vio.setting import Range, Section, setting

log = logging.getLogger(__name__)

if TYPE_CHECKING:
    BackendName = str
else:
    BackendName = Literal[tuple(BACKENDS)]
MotionName = Literal["auto", "imu", "velocity", "none"]
# The settings that a user may want to change first; `vio config --show` hides the others.
BASIC = (
    "motion", "backend", "lag_frames", "frontend.name", "frontend.features", "frontend.grid.target_features",
    "frontend.disparity.max_disparity", "frontend.klt.mask", "frontend.klt.equalise", "selector.name",
    "selector.budget", "imu.gravity_mps2", "imu.gyro_noise_density", "imu.accel_noise_density", "imu.gyro_bias_walk",
    "imu.accel_bias_walk", "msckf.clones", "msckf.max_landmarks", "msckf.calibrate_camera_imu",
    "msckf.calibrate_stereo",
)  # fmt: skip
# Former settings: renamed, whose values are still taken, and constants of the code today, for the
# message on an unknown one.
_RENAMED = {
    "msckf.calibrate": ("msckf.calibrate_camera_imu", "0.3"),
    **{f"msckf.{f.name}": (f"imu.{f.name}", "0.4") for f in fields(ImuSettings)},
}
_FIXED = {
    "frontend.grid": "cell_features min_distance",
    "frontend.disparity": "min_disparity_px",
    "frontend.consensus": "samples sure_share prior_max_deviation_deg prior_min_support",
    "frontend.klt": "min_gradient min_relative_gradient min_gradient_over_noise spare_corners "
    "window_px trusted_levels "
    "iterations max_forward_backward_px consensus_px anchor_radius_px min_anchor_correlation "
    "max_anchor_scale "
    "max_epipolar_px min_correlation min_peak_margin probation_frames wanted_life_frames "
    "least_features "
    "max_blind_frames max_left_only_frames",
    "frontend.match": "ratio search_radius max_epipolar_px refine consensus_px",
    "selector": "minimum horizon_frames pixel_sigma_px sticky",
    "vislam": "start_velocity_sigma_mps start_rate_sigma_radps landmark_prior_sigma_m "
    "max_landmark_distance_m",
    "msckf": "pixel_sigma_min_px start_tilt_sigma_deg start_velocity_sigma_mps "
    "zero_velocity_sigma_mps "
    "zero_rate_sigma_radps rate_bias_sigma_radps rate_bias_walk stereo_yaw_sigma_deg "
    "stereo_field_sigma "
    "imu_scale_sigma imu_misalignment_sigma_deg extrinsic_rotation_walk extrinsic_translation_walk "
    "time_offset_walk",
}
_PRESETS = Path(__file__).parent / "presets"  # packaged configurations, by name
_TYPES = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    Path: "a path",
}
_MAX_NAMED = 8  # settings in the message on an unknown one
_MAX_SHOWN = 200  # characters of a wrong value in a message

_Section = TypeVar("_Section")


@dataclass(frozen=True, slots=True)
class Config(Section):
    """Every setting of a run."""

    motion: MotionName = setting(
        "auto",
        "what carries the pose between frames; none: images alone; auto: the best that the "
        "recording has",
    )
    backend: BackendName = setting(
        "msckf", "the estimator: msckf, the sliding-window filter, or vislam, the paper's filter"
    )
    lag_frames: int = setting(
        0,
        "output each pose this many frames late, smoothed by the window (msckf, up to its clones); "
        "0: causal",
        at_least=0,
        at_most=100,
    )
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    frontend: FrontendSettings = field(default_factory=FrontendSettings)
    selector: SelectorSettings = field(default_factory=SelectorSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    vislam: VislamSettings = field(default_factory=VislamSettings)
    msckf: MsckfSettings = field(default_factory=MsckfSettings)


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> Config:
    """Build the configuration from the defaults, a YAML file and `a.b=value` overrides, in that
    order.

    A bare name of which there is no file, such as `fast`, is that of a preset in `vio/presets`.

    Raises:
        ConfigError: the file cannot be read, or a key or value is wrong.
    """
    if isinstance(overrides, (str, dict)):
        raise ConfigError(
            f"overrides: give a list such as ['motion=none'], not {type(overrides).__name__}"
        )
    config = Config()
    if path is not None:
        config = merge(config, _read_yaml(_preset_or(Path(path))), where=str(path))
    for override in overrides:
        config = merge_override(config, override, example="selector.budget=40")
    return config


def _preset_or(path: Path) -> Path:
    """Return the file of a preset where a path is its name, else the path."""
    if path.suffix or path.name != str(path) or path.is_file():
        return path
    preset = _PRESETS / f"{path}.yaml"
    if not preset.is_file():
        known = ", ".join(sorted(file.stem for file in _PRESETS.glob("*.yaml")))
        raise ConfigError(
            f"--config {path}: there is no such file, nor a preset of this name; presets are: "
            f"{known}"
        )
    return preset


def merge_override(section: _Section, override: str, *, example: str) -> _Section:
    """Return a copy of a section with one setting replaced, given as `a.b=value` as after `--set`.

    Raises:
        ConfigError: the text is no such pair (the message gives the example), or a key or value is
            wrong.
    """
    key, equals, text = override.partition("=") if isinstance(override, str) else ("", "", "")
    if not equals or not key.strip():
        raise ConfigError(f"--set takes key=value, got '{override}'; for example --set {example}")
    try:
        nested: Any = read_yaml(text)
    except ValueError as error:
        raise ConfigError(
            f"--set {_short(override)}: the value is not valid YAML ({error})"
        ) from error
    for part in reversed(key.strip().split(".")):
        nested = {part: nested}
    return merge(section, nested, where=f"--set {_short(override)}")


def merge(
    section: _Section, values: Mapping[str, Any], *, where: str, prefix: str = "", root: Any = None
) -> _Section:
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
    if isinstance(section, Config):
        values = _with_new_names(values, where)
    names = [f.name for f in fields(section)]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        path = f"{prefix}{_short(str(key))}"
        if key not in names:
            raise ConfigError(
                f"{where}: unknown setting "
                f"'{path}'{_suggestion(_short(str(key)), names, prefix, root)}"
            )
        current = getattr(section, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                example = f"{path}.{fields(current)[0].name}"
                raise ConfigError(
                    f"{where}: '{path}' is a section; give its settings, such as {example}"
                )
            changes[key] = merge(current, value, where=where, prefix=f"{path}.", root=root)
        else:
            changes[key] = _checked(value, hints[key], path, where)
    try:
        return dataclasses.replace(section, **changes)  # type: ignore[type-var]
    except ConfigError as error:  # a value out of range
        raise ConfigError(f"{where}: {error}") from error


def _with_new_names(values: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return the values of a whole configuration with renamed settings under their new names.

    Raises:
        ConfigError: a setting is given by both names.
    """
    out = dict(values)
    for old, (new, version) in _RENAMED.items():
        old_section, _, old_name = old.partition(".")
        new_section, _, new_name = new.partition(".")
        given = out.get(old_section)
        if not isinstance(given, Mapping) or old_name not in given:
            continue
        message = f"{where}: '{old}' is '{new}' since {version}"
        taken = out.get(new_section, {})
        if isinstance(taken, Mapping) and new_name in taken:
            raise ConfigError(f"{message}, and both are given; remove the first")
        log.warning("%s; rename it", message)
        out[old_section] = {name: value for name, value in given.items() if name != old_name}
        if isinstance(taken, Mapping):
            out[new_section] = {**out.get(new_section, {}), new_name: given[old_name]}
    return out


def as_dict(section: Any) -> dict[str, Any]:
    """Turn a configuration into nested plain dictionaries that YAML can hold."""
    return {
        f.name: as_dict(value) if is_dataclass(value := getattr(section, f.name)) else _plain(value)
        for f in fields(section)
    }


def to_yaml(config: Config) -> str:
    """Return the effective configuration as YAML; `load_config` reads it back to an equal one."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the same text in a quarter of the time
    try:
        text: str = yaml.dump(as_dict(config), Dumper=dumper, sort_keys=False, allow_unicode=True)
    except UnicodeEncodeError:  # a path with a byte that is no text
        text = yaml.safe_dump(as_dict(config), sort_keys=False, allow_unicode=True)
    return text


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """One row of `vio config --show`."""

    key: str
    group: str  # what the section of the setting is about
    default: Any
    unit: str
    choices: tuple[str, ...]
    range: str  # "at least 3", "above 0 and below 1", …; empty: any number
    doc: str


def describe(section: Any, prefix: str = "") -> Iterator[SettingInfo]:
    """Yield every setting with its default, unit and meaning."""
    hints = get_type_hints(type(section))
    summary = (type(section).__doc__ or "").partition("\n\n")[0]
    group = " ".join(summary.split()).rstrip(".")
    for f in fields(section):
        value = getattr(section, f.name)
        if is_dataclass(value):
            yield from describe(value, f"{prefix}{f.name}.")
        else:
            hint = hints[f.name]
            choices: tuple[str, ...] = ()
            if get_origin(hint) is Literal:
                choices = tuple(map(str, get_args(hint)))
            unit = f.metadata.get("unit", "")
            doc = f.metadata.get("doc", "")
            allowed = str(f.metadata.get("range", Range()))
            yield SettingInfo(f"{prefix}{f.name}", group, value, unit, choices, allowed, doc)


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        text = read_input(path, MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot read the configuration ({error.strerror}); check the path"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: the configuration is not UTF-8 text") from error
    try:
        values = read_yaml(text)
    except ValueError as error:
        remedy = "; replace tabs by spaces" if "character '\\t'" in str(error) else ""
        if text.startswith("%YAML:"):
            remedy = "; remove the first line, which is OpenCV's"
        raise ConfigError(f"{path}: not valid YAML ({error}){remedy}") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: a configuration is a mapping of settings, not a {type(values).__name__}"
        )
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
        return _chosen(value, get_args(hint), path, where)
    converted = _converted(value, hint)
    if not isinstance(converted, hint):
        got = f"{_short(repr(value))}{_number_hint(value, hint)}"
        raise ConfigError(f"{where}: {path} takes {_TYPES.get(hint, hint)}, got {got}")
    if hint is float and math.isnan(converted):
        raise ConfigError(f"{where}: {path} must be a number, got nan")
    return converted


def _converted(value: Any, hint: Any) -> Any:
    """Return a value of YAML in a setting's type where it stands for one; None: it does not."""
    if isinstance(value, bool):  # which Python takes for a whole number
        return value if hint is bool else None
    if hint is float and isinstance(value, int):
        if abs(value) < 2**1000:
            return float(value)
        return math.inf  # which no range allows
    if hint is Path and isinstance(value, str):
        return Path(value)
    return value


def _chosen(value: Any, choices: tuple[Any, ...], path: str, where: str) -> Any:
    """Return the value where it is one of the choices, or raise."""
    # YAML reads the bare words as truth values
    if isinstance(value, bool) and (word := "on" if value else "off") in choices:
        value = word
    if value in choices and type(value) in {type(c) for c in choices}:
        return value
    near = difflib.get_close_matches(_short(str(value)), choices, 1)
    hint_text = f"; did you mean '{near[0]}'?" if near else ""
    raise ConfigError(
        f"{where}: {path} is one of {', '.join(choices)}, not {_short(repr(value))}{hint_text}"
    )


def _number_hint(value: Any, hint: Any) -> str:
    if hint is float and isinstance(value, str):
        try:
            number = float(value)
        except ValueError:
            return ""
        if math.isfinite(number):
            plain = yaml.safe_dump(number).split()[0]  # 1.0e+300, where Python writes 1e+300
            return f" (to YAML 1.1 this is text; write {plain})"
    return ""


# First entries of calibrations, which are given as settings by mistake.
_OF_CALIBRATIONS = ("cam0", "cam1", "M1", "K1", "camera_matrix", "image_width", "File.version")


def _suggestion(key: str, names: Sequence[str], prefix: str, root: Any) -> str:
    """Suggest what to write for an unknown setting."""
    if key in _FIXED.get(prefix[:-1], "").split():
        return "; it is fixed since 0.3: remove it"
    if not prefix and key in _OF_CALIBRATIONS:
        return "; this is a calibration: give it with --calibration"
    if "." in key and prefix + key in (row.key for row in describe(root)):
        *parts, last = key.split(".")
        return f"; write it nested, as {': {'.join(parts)}: {{{last}: …{'}' * len(parts)}"
    near = _nearest_setting(key, names, prefix, root)
    if near is not None:
        return f"; did you mean '{near}'?"
    named = ", ".join(prefix + name for name in names[:_MAX_NAMED])
    more = len(names) - _MAX_NAMED
    return f"; valid here: {named}" + (
        f" and {more} more, see vio config --all" if more > 0 else ""
    )


def _nearest_setting(key: str, names: Sequence[str], prefix: str, root: Any) -> str | None:
    """Return the same name in a sibling section, a similar one here, or the same name anywhere.

    A name may be split over section and setting: `consensus_samples` is `consensus.samples`.
    """
    same_name = [
        row.key for row in describe(root) if f".{row.key}".replace(".", "_").endswith(f"_{key}")
    ]
    siblings = [name for name in same_name if name.startswith(prefix[: prefix.find(".") + 1])]
    similar = [prefix + name for name in difflib.get_close_matches(key, names, 1, cutoff=0.4)]
    return next(iter(siblings + similar + same_name), None)


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value


def _short(value: Any) -> str:
    """Return a value for a message, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    if len(text) <= _MAX_SHOWN:
        return text
    return f"{text[:_MAX_SHOWN]}…"
