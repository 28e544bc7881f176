"""A suite: which recordings are run with which configurations and seeds, read from YAML."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from vio.config import Config, load_config, merge
from vio.datasets.frame_times import parse_bound
from vio.errors import ConfigError
from vio.files.inputs import read_input
from vio.files.yaml_text import MAX_BYTES, read_yaml

SHIPPED = Path(__file__).resolve().parent / "suites"
# of a sequence or configuration: it becomes part of a command line and of a CSV file
_NAME = re.compile(r"[\w.+-]+")
_MAX_SEEDS = 1000
SUCCESS_PERCENT = 1.0  # of the path, where a suite says nothing else
PUBLISHED_MEAN = "all"  # in the place of a sequence: the source's own mean
_PUBLISHED_FIGURES = ("ate_m", "drift_percent", "drift_deg_per_100m")
# of `vio render`: given by the bench itself
_RENDER_OWN = ("--out", "--seed", "--workers", "--json")


@dataclass(frozen=True, slots=True)
class Sequence:
    """One recording of a suite: exactly one of `source` and `render`."""

    name: str
    source: str | None = None  # as `vio run` takes it, relative to the data folder
    render: tuple[str, ...] = ()  # arguments of `vio render`
    render_each_seed: bool = False  # render anew with every seed; else with seed 0
    # ground truth in place of the recording's own, relative to the data folder
    reference: str | None = None
    start: str = "0"  # first frame, or a time such as 12s
    stop: str | None = None
    lengths_m: tuple[float, ...] | None = None  # path lengths of the drift; None: KITTI's
    # the reference's orientations mean nothing: no relative errors, no NEES
    positions_only: bool = False
    # so much better than the estimate that NEES says something; None: if rendered
    exact_truth: bool | None = None
    settings: Mapping[str, Any] | None = None  # over those of the configuration
    map: bool = False  # build a map, and score it
    # the sequence in whose map this one is localised, built beforehand in the same task
    map_of: str | None = None
    # from, to: the images are black meanwhile, and the rig is moved
    covered: tuple[tuple[str, str], ...] = ()
    # name of the stereo rig that took it; fields of sequences of one rig are compared, and halves
    # of the rigs are cross-validated; None: a rig of its own
    rig: str | None = None
    # the frames in reverse order, without motion samples
    reverse: bool = False


@dataclass(frozen=True, slots=True)
class Published:
    """Figures that others have published on sequences of the suite."""

    system: str
    source: str  # paper or page, with its table
    figures: Mapping[str, Mapping[str, float]]  # by name of the figure, by sequence
    sensors: str  # such as stereo + IMU
    causal: bool | None  # poses as they were output, or later ones; None: the source does not say
    alignment: str | None  # SE3, Sim3
    loops: bool | None

    @property
    def conditions(self) -> tuple[str, str, str, str]:
        """Sensors, causal, alignment and loops, for a table."""
        causal, loops = (
            "?" if v is None else "yes" if v else "no" for v in (self.causal, self.loops)
        )
        return self.sensors, causal, self.alignment or "?", loops


@dataclass(frozen=True, slots=True)
class Suite:
    """All that a bench runs."""

    name: str
    folder: Path  # of the file; relative paths of settings are relative to it
    sequences: tuple[Sequence, ...]
    configurations: Mapping[str, Mapping[str, Any]]  # deviations from the defaults
    seeds: tuple[int, ...] = (0,)
    published: tuple[Published, ...] = ()
    # of sequences and systems, for tables in documents
    titles: Mapping[str, str] = field(default_factory=dict)
    publisher: str | None = None  # where the recordings can be had
    # a run with an ATE below this share of the path succeeds
    success_percent: float = SUCCESS_PERCENT
    time_limit_s: float | None = None  # of a task; then it has no result


def shipped_suites() -> tuple[str, ...]:
    """Names of the suites that come with the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.yaml")))


def read_suite(what: str) -> Suite:
    """Read a suite: the path of a YAML file, or the name of a shipped one.

    Raises:
        ConfigError: the file cannot be read, or a key or value is wrong; the message names file and
            key.
    """
    path = Path(what)
    if not path.is_file() and what in shipped_suites():
        path = SHIPPED / f"{what}.yaml"
    try:
        values = read_yaml(read_input(path, MAX_BYTES).decode("utf-8-sig"))
    except OSError as error:
        names = ", ".join(shipped_suites())
        reason = error.strerror or error
        raise ConfigError(
            f"{what}: no suite ({reason}); give a YAML file or one of {names}"
        ) from error
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error})") from error
    return suite_from(values, path)


def suite_from(values: Any, path: Path) -> Suite:
    """Build a suite from the data of its file.

    Raises:
        ConfigError: a key or value is wrong.
    """
    where = str(path)
    given = _mapping(values, where, "a suite")
    _only_keys(given, [f.name for f in fields(Suite) if f.name != "folder"], where)
    sequences = _named(given.get("sequences"), where, "'sequences'")
    configurations = _named(
        given.get("configurations") or {"default": {}}, where, "'configurations'"
    )
    if not sequences:
        raise ConfigError(f"{where}: no sequences; name at least one")
    titles = _mapping(given.get("titles") or {}, where, "'titles'")
    publisher = given.get("publisher")
    published = given.get("published") or ()
    suite = Suite(
        name=str(given.get("name", path.stem)),
        folder=path.resolve().parent,
        sequences=tuple(_sequences(sequences, where)),
        configurations=_settings_by_name(configurations, where),
        seeds=_seeds(given.get("seeds", [0]), where),
        published=tuple(_published(value, where, sequences) for value in published),
        titles=_texts(titles),
        publisher=None if publisher is None else str(publisher),
        success_percent=_positive(
            given.get("success_percent", SUCCESS_PERCENT), "success_percent", where
        ),
        time_limit_s=_time_limit(given.get("time_limit_s"), where),
    )
    _check_combinations(suite, where)
    return suite


def _sequences(given: Mapping[Any, Any], where: str) -> Iterator[Sequence]:
    for name, value in given.items():
        yield _sequence(str(name), value, where)


def _time_limit(value: Any, where: str) -> float | None:
    return None if value is None else _positive(value, "time_limit_s", where)


def _texts(given: Mapping[Any, Any]) -> dict[str, str]:
    return {str(name): str(value) for name, value in given.items()}


def _settings_by_name(configurations: Mapping[Any, Any], where: str) -> dict[str, Any]:
    """Return the settings of each configuration; those of one without any are empty."""
    return {
        str(name): _mapping(value or {}, where, f"'{name}'")
        for name, value in configurations.items()
    }


def _check_combinations(suite: Suite, where: str) -> None:
    """Raise where a sequence needs the map of none, or a run's settings are wrong."""
    known = [sequence.name for sequence in suite.sequences]
    for sequence in suite.sequences:
        if sequence.map_of is not None and (sequence.map or sequence.map_of not in known):
            names = f"map_of of {sequence.name} names another sequence of the suite"
            raise ConfigError(f"{where}: {names}, without map: true")
    for configuration in suite.configurations:
        for sequence in suite.sequences:
            config_of(suite, sequence, configuration, suite.seeds[0])


def config_of(suite: Suite, sequence: Sequence, configuration: str, seed: int) -> Config:
    """Return every setting of one run: defaults < `config:` file < configuration < sequence < seed.

    The seed is that of the front end's random sampling, `frontend.consensus.seed`.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """
    where = f"{suite.name}, configuration {configuration}"
    values = dict(suite.configurations[configuration])
    file = values.pop("config", None)
    config = load_config(None if file is None else suite.folder / str(file))
    config = merge(config, _nested(values, where), where=where)
    config = merge(
        config,
        _nested(sequence.settings or {}, where),
        where=f"{suite.name}, sequence {sequence.name}",
    )
    return merge(config, {"frontend": {"consensus": {"seed": seed}}}, where="seeds")


def chosen(suite: Suite, only: Iterable[str], configurations: Iterable[str]) -> Suite:
    """Return the suite with the named sequences and configurations alone, and the maps that they
    need; none named: all.

    Raises:
        ConfigError: a name is unknown.
    """
    sequences = tuple(only)
    configured = tuple(configurations)
    _check_known(suite, sequences, [s.name for s in suite.sequences])
    _check_known(suite, configured, list(suite.configurations))
    if sequences:
        needed = {*sequences, *(s.map_of for s in suite.sequences if s.name in sequences)}
        suite = replace(suite, sequences=tuple(s for s in suite.sequences if s.name in needed))
    if configured:
        kept = {name: v for name, v in suite.configurations.items() if name in configured}
        suite = replace(suite, configurations=kept)
    return suite


def _check_known(suite: Suite, names: Iterable[str], known: list[str]) -> None:
    """Raise ConfigError where a suite has nothing of a name."""
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            if near:
                hint = f"; did you mean '{near[0]}'?"
            else:
                hint = f"; it holds {', '.join(known[:8])}"
            raise ConfigError(f"suite {suite.name} has no '{name}'{hint}")


def _named(value: Any, where: str, what: str) -> Mapping[Any, Any]:
    """Return a mapping whose keys are names."""
    given = _mapping(value, where, what)
    for name in given:
        if not _NAME.fullmatch(str(name)):
            raise ConfigError(f"{where}: '{name}' is no name; use letters, digits and . _ + -")
    return given


_KEYS_OF_SEQUENCE = [f.name for f in fields(Sequence) if f.name != "name"]


def _sequence(name: str, value: Any, where: str) -> Sequence:
    place = f"{where}, sequence {name}"
    given: dict[str, Any] = {"source": value}
    if not isinstance(value, str):
        given = dict(_mapping(value, where, f"sequence {name}"))
    _only_keys(given, _KEYS_OF_SEQUENCE, place)
    if ("source" in given) == ("render" in given):
        raise ConfigError(f"{place}: give either source or render")
    if "render" in given:
        given["render"] = _render_words(given["render"], place)
    try:
        given |= _span(given)
        if given.get("lengths_m") is not None:
            given["lengths_m"] = _lengths_m(given["lengths_m"])
    except (ValueError, TypeError) as error:
        text = "start and stop are frames or times as 12s, covered pairs of them, lengths_m metres"
        raise ConfigError(f"{place}: {text} ({error})") from error
    _check_truths(given, place)
    texts = ("source", "reference", "map_of", "rig")
    given |= {key: str(given[key]) for key in texts if given.get(key) is not None}
    _mapping(given.get("settings") or {}, where, f"settings of sequence {name}")
    return Sequence(name=name, **given)


def _check_truths(given: Mapping[str, Any], place: str) -> None:
    """Raise ConfigError where a sequence answers a question by something else than yes or no."""
    for key in ("render_each_seed", "positions_only", "exact_truth", "map", "reverse"):
        if not isinstance(given.get(key, False), bool):
            raise ConfigError(f"{place}: {key} takes true or false, got {given[key]!r}")


def _render_words(words: Any, place: str) -> tuple[str, ...]:
    """Return the options of a render, none of which is the bench's own."""
    options = tuple(shlex.split(words) if isinstance(words, str) else map(str, words))
    own = [word for word in options if _names_own_option(word)]
    if own:
        raise ConfigError(f"{place}: {own[0]} is set by the bench; leave it out")
    return options


def _span(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the bounds of what is run of a sequence and of what its reference covers.

    Raises:
        ValueError, TypeError: one is no bound.
    """
    out: dict[str, Any] = {
        key: str(given[key]) for key in ("start", "stop") if given.get(key) is not None
    }
    covered = tuple((str(begin), str(end)) for begin, end in given.get("covered") or ())
    for bound in (*out.values(), *(bound for span in covered for bound in span)):
        parse_bound(bound)
    return {**out, "covered": covered}


def _lengths_m(values: Any) -> tuple[float, ...]:
    """Return the lengths of pieces.

    Raises:
        ValueError, TypeError: there is none, or one is no length.
    """
    lengths_m = tuple(float(v) for v in values)
    if not lengths_m or any(not 0 < v < float("inf") for v in lengths_m):
        raise ValueError(f"lengths_m {lengths_m}")
    return lengths_m


def _names_own_option(word: str) -> bool:
    """Whether a word is an option that the bench itself gives, in full or abbreviated."""
    name = word.partition("=")[0]
    return len(name) > 2 and any(option.startswith(name) for option in _RENDER_OWN)


def _published(value: Any, where: str, sequences: Iterable[str]) -> Published:
    given = dict(_mapping(value, where, "an entry of 'published'"))
    system = given.pop("system", None)
    source = given.pop("source", None)
    if not system or not source:
        raise ConfigError(f"{where}: published figures need a system and a source")
    conditions = {
        name: given.pop(name, None) for name in ("sensors", "causal", "alignment", "loops")
    }
    if not conditions["sensors"] or conditions["alignment"] not in (None, "SE3", "Sim3"):
        raise ConfigError(f"{where}: {system} needs sensors, and as alignment SE3, Sim3 or none")
    if any(conditions[name] not in (None, True, False) for name in ("causal", "loops")):
        takes = "true, false or, where the source is silent, none"
        raise ConfigError(f"{where}: causal and loops of {system} take {takes}")
    places = {PUBLISHED_MEAN, *map(str, sequences)}
    figures = {
        name: _published_figures(name, value, where, system, places)
        for name, value in given.items()
    }
    return Published(str(system), str(source), figures, **conditions)


def _published_figures(
    name: str, value: Any, where: str, system: Any, places: Collection[str]
) -> dict[str, Any]:
    """Return the figures of one kind by sequence.

    Raises:
        ConfigError: there is no such kind or place, or a figure is no number.
    """
    if name not in _PUBLISHED_FIGURES:
        raise ConfigError(
            f"{where}: {system} has unknown '{name}'; figures are {', '.join(_PUBLISHED_FIGURES)}"
        )
    figures = {str(k): v for k, v in _mapping(value, where, f"'{name}' of {system}").items()}
    for sequence, figure in figures.items():
        if sequence not in places:
            raise ConfigError(
                f"{where}: {name} of {system} names {sequence}, which is no sequence of the suite"
            )
        if isinstance(figure, bool) or not isinstance(figure, (int, float)) or not figure >= 0:
            raise ConfigError(
                f"{where}: {name} of {system} on {sequence} is a number, got {figure!r}"
            )
    return figures


def _positive(value: Any, name: str, where: str) -> float:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not 0 < value < float("inf")
    ):
        raise ConfigError(f"{where}: {name} is a number above 0, got {value!r}")
    return float(value)


def _seeds(value: Any, where: str) -> tuple[int, ...]:
    if isinstance(value, int) and not isinstance(value, bool):
        seeds = list(range(value))
    else:
        seeds = value
    fine = (
        isinstance(seeds, list)
        and 0 < len(seeds) <= _MAX_SEEDS
        and len(set(map(str, seeds))) == len(seeds)
    )
    if not fine or any(
        not isinstance(s, int) or isinstance(s, bool) or not 0 <= s < 2**32 for s in seeds
    ):
        raise ConfigError(
            f"{where}: seeds takes different whole numbers such as [0, 1, 2], or how many; got "
            f"{value!r}"
        )
    return tuple(seeds)


def _nested(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Turn `a.b: 1` into `a: {b: 1}`, as deep as the dots go, beside settings that are nested
    already.
    """
    out: dict[str, Any] = {}
    for key, value in values.items():
        *sections, last = str(key).split(".")
        inner = out
        for section in sections:
            inner = inner.setdefault(section, {})
            if not isinstance(inner, dict):
                raise ConfigError(
                    f"{where}: '{key}' and '{section}' exclude each other; give one of them"
                )
        if isinstance(value, dict):
            inner[last] = {**inner.get(last, {}), **value}
        else:
            inner[last] = value
    return out


def _mapping(value: Any, where: str, what: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: {what} is a mapping of names, not {type(value).__name__}")
    return value


def _only_keys(given: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    names = list(known)
    for key in given:
        if key not in names:
            near = difflib.get_close_matches(str(key), names, 1)
            if near:
                hint = f"did you mean '{near[0]}'?"
            else:
                hint = f"valid here: {', '.join(names)}"
            raise ConfigError(f"{where}: unknown key '{key}'; {hint}")
