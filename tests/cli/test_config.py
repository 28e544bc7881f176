"""The configuration: precedence, strictness, messages with a remedy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vio.config import Config, SettingInfo, as_dict, describe, load_config, to_yaml
from vio.errors import ConfigError
from vio.filters.settings import MsckfSettings

ROOT = Path(__file__).resolve().parents[2]


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("word", ["on", "off", '"off"'])
def test_on_and_off_need_no_quotes(word: str, tmp_path: Path) -> None:
    for config in (
        load_config(None, [f"msckf.calibrate_stereo={word}"]),
        load_config(_write(tmp_path, f"msckf:\n  calibrate_stereo: {word}\n")),
    ):
        assert config.msckf.calibrate_stereo == word.strip('"')
        assert load_config(_write(tmp_path, to_yaml(config))) == config


@pytest.mark.parametrize("word", ["off", '"off"'])
def test_off_beside_other_words_needs_no_quotes(word: str, tmp_path: Path) -> None:
    for config in (
        load_config(None, [f"msckf.calibrate_imu={word}"]),
        load_config(_write(tmp_path, f"msckf:\n  calibrate_imu: {word}\n")),
    ):
        assert config.msckf.calibrate_imu == "off"
    with pytest.raises(ConfigError, match="calibrate_imu is one of auto, off, scale, full"):
        load_config(None, ["msckf.calibrate_imu=on"])


def test_defaults_then_file_then_command_line(tmp_path: Path) -> None:
    path = _write(
        tmp_path, "vislam:\n  pixel_sigma_px: 2\n  iterations: 3\nselector:\n  name: information\n"
    )
    config = load_config(path, ["vislam.iterations=5", "selector.keep_fraction=0.5"])
    assert config.vislam.pixel_sigma_px == 2.0
    assert isinstance(config.vislam.pixel_sigma_px, float)
    assert config.vislam.iterations == 5
    assert config.selector.name == "information"
    assert config.selector.keep_fraction == 0.5
    assert config.frontend == Config().frontend


def test_effective_configuration_reads_back_equal(tmp_path: Path) -> None:
    config = load_config(
        None, ["vislam.gate_probability=null", "motion=none", "selector.name=visibility"]
    )
    assert config.vislam.gate_probability is None
    assert load_config(_write(tmp_path, to_yaml(config))) == config


def test_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert load_config(_write(tmp_path, "")) == Config()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "vislam:\n  pixel_sigma: 2\n",
            r"my\.yaml: unknown setting 'vislam\.pixel_sigma'; did you mean "
            r"'vislam\.pixel_sigma_px'",
        ),
        ("visalm:\n  iterations: 2\n", r"did you mean 'vislam'"),
        ("zzzzqq: 1\n", r"valid here: motion, backend"),
        (
            "frontend:\n  klt:\n    target_features: 300\n",
            r"did you mean 'frontend\.grid\.target_features'",
        ),
        (
            "frontend:\n  match:\n    consensus_seed: 9\n",
            r"did you mean 'frontend\.consensus\.seed'",
        ),
        (
            "frontend:\n  match:\n    max_points: 2\n",
            r"did you mean 'frontend\.match\.max_keypoints'",
        ),
        (
            "frontend:\n  klt:\n    window_px: 21\n",
            r"'frontend\.klt\.window_px'; it is fixed since 0\.3",
        ),
        ("target_features: 300\n", r"did you mean 'frontend\.grid\.target_features'"),
        ("vislam: 3\n", r"'vislam' is a section"),
        ("vislam:\n  iterations: 2.5\n", r"vislam\.iterations takes a whole number, got 2\.5"),
        ("vislam:\n  iterations: true\n", r"takes a whole number, got True"),
        ("vislam:\n  pixel_sigma_px: 1e-3\n", r"to YAML 1\.1 this is text; write 0\.001"),
        (
            "vislam:\n  pixel_sigma_px: 1e300\n",
            r"got '1e300' \(to YAML 1\.1 this is text; write 1\.0e\+300\)",
        ),
        ("vislam:\n  pixel_sigma_px: nan\n", r"got 'nan'$"),
        ("vislam:\n  pixel_sigma_px: .nan\n", r"must be a number, got nan"),
        ("vislam:\n  use_stale: 1\n", r"takes true or false, got 1"),
        (
            "vislam:\n  noise: litral\n",
            r"is one of consistent, literal, not 'litral'; did you mean 'literal'",
        ),
        ("- 1\n- 2\n", r"is a mapping of settings, not a list"),
        ("msckf:\n  clones: 5\nmsckf:\n  clones: 7\n", r"'msckf' is given twice"),
        ("vislam: [\n", r"not valid YAML"),
        ("msckf:\n\tclones: 5\n", r"not valid YAML .*; replace tabs by spaces"),
        ("%YAML:1.0\n---\nmotion: imu\n", r"remove the first line, which is OpenCV's"),
        ("msckf:\n  clones: 1:30\n", r"takes a whole number, got '1:30'"),
        ("imu:\n  gravity_mps2: 1:30.5\n", r"takes a number, got '1:30\.5'"),
        ("msckf.clones: 8\n", r"write it nested, as msckf: \{clones: …\}"),
        (
            "frontend.grid.target_features: 300\n",
            r"nested, as frontend: \{grid: \{target_features: …\}\}",
        ),
        ("motion:\n", r"motion is one of auto"),
    ],
)
def test_reports_mistakes_in_the_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(_write(tmp_path, text))


def test_names_what_is_no_text_among_overrides() -> None:
    nothing: Any = None
    with pytest.raises(ConfigError, match="--set takes key=value, got 'None'"):
        load_config(overrides=[nothing])


@pytest.mark.parametrize(("digits", "size"), [("010", 10), ("0x10", 16), ("+1_0", 10)])
def test_whole_numbers_are_those_that_people_read(digits: str, size: int) -> None:
    """To YAML 1.1 a leading zero is that of a number to the base of 8."""
    assert load_config(overrides=[f"msckf.clones={digits}"]).msckf.clones == size


@pytest.mark.parametrize(
    "override", ["vislam.iterations", "=3", "vislam.iterations=[", "vislam=3", "a.b.c=1"]
)
def test_reports_mistakes_in_an_override(override: str) -> None:
    with pytest.raises(ConfigError, match="--set"):
        load_config(None, [override])


def test_reports_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml.*check the path"):
        load_config(tmp_path / "none.yaml")


def test_reports_a_binary_file(tmp_path: Path) -> None:
    path = tmp_path / "image.yaml"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ConfigError, match=r"image\.yaml"):
        load_config(path)


def test_every_setting_has_a_description_and_quantities_have_units() -> None:
    rows = list(describe(Config()))
    assert len({row.key for row in rows}) == len(rows)
    for row in rows:
        assert row.doc, f"{row.key} has no description"
        for suffix in ("_px", "_mps", "_m", "_s", "_deg", "_radps", "_mps2", "_radps2"):
            if row.key.endswith(suffix):
                assert row.unit, f"{row.key} has no unit"


def test_shipped_files_are_valid_and_contain_deviations_only() -> None:
    folder = Path(__file__).resolve().parents[2] / "configs"
    files = sorted(folder.glob("*.yaml"))
    assert files
    defaults = as_dict(Config())
    for file in files:
        assert as_dict(load_config(file)) != defaults


def _numbers() -> list[SettingInfo]:
    return [
        s
        for s in describe(Config())
        if isinstance(s.default, (int, float)) and not isinstance(s.default, bool)
    ]


@pytest.mark.parametrize("info", _numbers(), ids=lambda info: info.key)
def test_every_number_has_a_range_and_other_values_are_rejected(info: SettingInfo) -> None:
    assert info.range, "declare its allowed range"
    for word in info.range.split(" and "):
        name, bound = word.rsplit(" ", 1)
        outward = -1 if name in ("at least", "above") else 1
        step = (
            outward
            if isinstance(info.default, int)
            else outward * max(abs(float(bound)), 1.0) * 1e-6
        )
        outside = float(bound) + (step if name.startswith("at") else 0)
        text = str(int(outside)) if isinstance(info.default, int) else f"{outside:.9f}"
        with pytest.raises(
            ConfigError, match=rf"--set {info.key}.*{info.key} must be {info.range}, got"
        ):
            load_config(None, [f"{info.key}={text}"])
        if name.startswith("at"):
            load_config(
                None, [f"{info.key}={bound if isinstance(info.default, int) else float(bound)}"]
            )


def test_rejects_infinite_numbers_and_checks_ranges_in_code() -> None:
    with pytest.raises(ConfigError, match=r"imu\.gravity_mps2 must be finite"):
        load_config(None, ["imu.gravity_mps2=.inf"])
    with pytest.raises(
        ConfigError, match=r"msckf\.clones must be at least 3 and at most 100, got 2"
    ):
        MsckfSettings(clones=2)
    with pytest.raises(ConfigError, match=r"msckf\.pixel_sigma_max_px must be above 0, got -3"):
        MsckfSettings(pixel_sigma_max_px=-3.0)


@pytest.mark.parametrize(
    ("old", "new", "value"),
    [
        ("msckf.calibrate", "msckf.calibrate_camera_imu", "both"),
        ("msckf.gravity_mps2", "imu.gravity_mps2", 9.79),
        ("msckf.gyro_noise_density", "imu.gyro_noise_density", 1e-3),
        ("msckf.accel_bias_sigma_mps2", "imu.accel_bias_sigma_mps2", 0.5),
    ],
)
def test_takes_a_setting_by_its_former_name_and_says_the_new_one(
    old: str, new: str, value: object, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    section, _, name = old.partition(".")
    path = tmp_path / "old.yaml"
    path.write_text(f"{section}:\n  clones: 9\n  {name}: {value}\n")
    expected = load_config(None, [f"{new}={value}", "msckf.clones=9"])
    assert load_config(path) == load_config(None, [f"{old}={value}", "msckf.clones=9"]) == expected
    version = "0.3" if old == "msckf.calibrate" else "0.4"
    said = f"'{old}' is '{new}' since {version}; rename it"
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [f"{path}: {said}", f"--set {old}={value}: {said}"]


def test_refuses_a_setting_by_both_of_its_names(tmp_path: Path) -> None:
    path = tmp_path / "both.yaml"
    path.write_text("msckf:\n  gravity_mps2: 9.79\nimu:\n  gravity_mps2: 9.8\n")
    with pytest.raises(ConfigError, match=r"'imu\.gravity_mps2' since 0\.4, and both are given"):
        load_config(path)
    path.write_text("msckf:\n  gravity_mps2: 9.79\nimu: 3\n")
    with pytest.raises(ConfigError, match="'imu' is a section"):
        load_config(path)
    path.write_text("msckf:\n  gravity_mps2: heavy\n")
    with pytest.raises(ConfigError, match=r"imu\.gravity_mps2 takes a number"):
        load_config(path)


def test_preset_is_found_by_its_name_and_is_packaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fast, default = load_config(Path("fast")), Config()
    assert fast.frontend.grid.target_features < default.frontend.grid.target_features
    assert fast.msckf.clones < default.msckf.clones
    with pytest.raises(ConfigError, match="nor a preset of this name; presets are: fast"):
        load_config(Path("quick"))
    Path("fast").write_text("lag_frames: 2\n")  # a file of the user's goes first
    assert load_config(Path("fast")) == replace(default, lag_frames=2)
    assert '"*" = ["py.typed", "*.yaml"]' in (ROOT / "pyproject.toml").read_text()
