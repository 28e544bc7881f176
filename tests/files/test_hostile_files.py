"""Files and settings made to exhaust memory or stack, or to block: each is an error in one line,
at once.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.test_config import _numbers
from tests.commands import refused
from tests.dataset_makers import (
    ece276a_arrays,
    make_drive,
    make_kitti,
    make_mat,
    make_npz,
    utias_arrays,
)
from tests.datasets.test_datasets_png import chunk
from tests.same_events import frames_of
from vio.config import SettingInfo, load_config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.common import read_npz
from vio.datasets.image_pairs import gray_levels
from vio.datasets.images import UnreadableImageError, levels_in, load_gray
from vio.datasets.levels import Levels
from vio.errors import ConfigError, DataError
from vio.files.tables import check_table
from vio.files.text import text_lines
from vio.files.yaml_text import read_yaml
from vio.filters.settings import MsckfSettings
from vio.runs.finished import read_estimates
from vio.runs.tables import ESTIMATE

PIXELS = np.random.default_rng(5).integers(0, 256, (24, 32)).astype(np.uint8)


def png_stating(width: int, height: int) -> bytes:
    """A complete PNG, with right checksums, whose header states a size that its pixels do not
    have.
    """
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )


def _jpeg(path: Path) -> bytes:
    assert cv2.imwrite(str(path), cv2.blur(PIXELS, (5, 5)))
    return path.read_bytes()


@pytest.mark.parametrize(("width", "height"), [(2**15, 2**15), (2**30, 1), (2**31 - 1, 2**31 - 1)])
def test_image_size_is_checked_before_decoding(width: int, height: int, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png_stating(width, height))
    with pytest.raises(
        UnreadableImageError,
        match=rf"a\.png: its header states {width} x {height} pixels, more than",
    ):
        load_gray(tmp_path / "a.png")


def test_jpeg_size_is_checked_before_decoding(tmp_path: Path) -> None:
    data = bytearray(_jpeg(tmp_path / "a.jpg"))
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", 65500, 65500)
    (tmp_path / "a.jpg").write_bytes(bytes(data))
    with pytest.raises(UnreadableImageError, match="its header states 65500 x 65500 pixels"):
        load_gray(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    "tail", [b"\0\0", b"a preview \xff\xd8 or a video", b"\xff\xff\xd9 padding"]
)
def test_bytes_after_the_end_of_a_jpeg_are_passed_over(tail: bytes, tmp_path: Path) -> None:
    whole = _jpeg(tmp_path / "a.jpg")
    expected, _ = load_gray(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(whole + tail)
    np.testing.assert_array_equal(load_gray(tmp_path / "a.jpg")[0], expected)


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("tail", [b"", b"\0" * 50])
def test_truncated_jpegs_are_still_refused(kept: float, tail: bytes, tmp_path: Path) -> None:
    whole = _jpeg(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(whole[: int(kept * len(whole))] + tail)
    with pytest.raises(UnreadableImageError, match="the JPEG is truncated"):
        load_gray(tmp_path / "a.jpg")


# --- 16 bits
# --------------------------------------------------------------------------------------------------


def _deep_recording(folder: Path, top: int) -> Path:
    """A recording whose 16-bit images hold levels up to `top`; the first frames are dark."""
    make_kitti(folder, frames=12)
    ramp = np.linspace(0, 1, 24 * 32).reshape(24, 32)
    for k in range(12):
        light = 0.2 if k < 3 else 1.0
        for side in ("image_0", "image_1"):
            image = np.rint(light * top * ramp).astype(np.uint16)
            assert cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    return folder


@pytest.mark.parametrize(("top", "bits"), [(1023, 10), (4095, 12), (16383, 14)])
def test_bits_in_use_are_scaled_by_one_factor_for_the_whole_run(
    top: int, bits: int, tmp_path: Path
) -> None:
    dataset = open_dataset(_deep_recording(tmp_path / "deep", top))
    assert f"the images have 16 bits but use {bits}: the levels 0 to {top}" in " ".join(
        dataset.recording.notes
    )
    frames = frames_of(dataset)
    brightest = [int(frame.left.max()) for frame in frames if frame.left is not None]
    # the dark ones stay darker: the brightness does not jump
    assert brightest == [51] * 3 + [255] * 9


def test_no_image_is_taken_for_one_of_16_bits() -> None:
    assert levels_in([]) == gray_levels(())[0] == Levels(0, 65535)


# --- archives
# --------------------------------------------------------------------------------------------------


def add_bomb(path: Path, name: str, gib: float) -> None:
    """Add an array of zeros to an archive, of which the file holds a thousandth at most."""
    shape = (int(gib * 2**27),)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        info = zipfile.ZipInfo(f"{name}.npy")
        info.compress_type = zipfile.ZIP_BZIP2
        with archive.open(info, "w", force_zip64=True) as stream:
            np.lib.format.write_array_header_1_0(
                stream, {"descr": "<f8", "fortran_order": False, "shape": shape}
            )
            stream.write(bytes(2**20))  # as if it were more: the tests never get to its end


def test_unused_arrays_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_npz(tmp_path / "drive.npz", ece276a_arrays(make_drive(6)))
    add_bomb(path, "unused", 3.9)
    assert len(open_dataset(path).recording.frame_times_ns) == 6


def test_needed_arrays_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_npz(tmp_path / "drive.npz", ece276a_arrays(make_drive(6)))
    monkeypatch.setattr("vio.datasets.common._MAX_ARRAY_BYTES", 2**14)
    with pytest.raises(DataError, match=r"drive\.npz: its arrays take .* GiB \(features alone"):
        open_dataset(path)
    mat = make_mat(tmp_path / "drive.mat", utias_arrays(make_drive(6)))
    with pytest.raises(DataError, match=r"drive\.mat: its arrays take"):
        open_dataset(mat)


# --- YAML
# --------------------------------------------------------------------------------------------------

ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(9)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: " + "[" * 5000, "nested deeper than 32 levels"),
        ("a: " + "[" * 5000 + "]" * 5000, "nested deeper than 32 levels"),
        ("".join(" " * k + f"k{k}:\n" for k in range(200)), "nested deeper than 32 levels"),
        (ALIASES, "more than 20000 values"),
        ("a: &a [*a]", "the value of &a contains itself"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("a: 2026-13-45", "does not fit its type"),
        ("a: !!bool maybe", "does not fit its type"),
        ("a: !!int x", "does not fit its type"),
        ("a: " + "9" * 5000, "does not fit its type"),
        ("!!map [1]", "expected a mapping node"),
        ("? [1]\n: 2", "unhashable"),
        ("a: \x07", "special characters are not allowed"),
    ],
    ids=lambda text: text[:12],
)
def test_hostile_yaml_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read_yaml(text)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_config(tmp_path / "a.yaml")


def test_plain_aliases_are_read() -> None:
    assert read_yaml("a: &a [1, 2]\nb: *a\nc: {d: *a}") == {
        "a": [1, 2],
        "b": [1, 2],
        "c": {"d": [1, 2]},
    }
    with pytest.raises(ValueError, match="found undefined alias"):
        read_yaml("a: *b")


def test_long_wrong_values_are_cut(tmp_path: Path) -> None:
    for override in (f"motion={'x' * 10_000}", f"msckf.clones={'x' * 10_000}", f"{'y' * 10_000}=1"):
        with pytest.raises(ConfigError) as error:
            load_config(None, [override])
        assert len(str(error.value)) < 2000


# --- pipes and devices
# ----------------------------------------------------------------------------------------------


def test_pipes_and_devices_do_not_block(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "pipe.npz"
    os.mkfifo(pipe)
    for argv in (
        ["run", str(pipe)],
        ["run", f"ece276a:{pipe}"],
        ["run", f"log:{pipe}"],
        ["run", f"utias:{pipe}"],
        ["run", "/dev/zero"],
        ["eval", str(pipe), str(pipe)],
        ["config", "--config", str(pipe)],
        ["config", "--config", "/dev/zero"],
    ):
        error = refused(capsys, *argv)
        assert "it is a pipe, socket or device, no file" in error, argv
    with pytest.raises(DataError, match="no file"):
        text_lines(Path("/dev/zero"))
    folder = make_kitti(tmp_path / "kitti")
    for name in ("image_0/000000.png", "image_1/000002.png"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    frames = frames_of(open_dataset(folder))
    assert [frame.index for frame in frames] == [1, 3]


# --- settings
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("info", _numbers(), ids=lambda info: info.key)
def test_huge_and_vanishing_settings_are_refused(info: SettingInfo) -> None:
    for text in (
        ("1000000000000", "1" + 400 * "0")
        if isinstance(info.default, int)
        else ("1.0e+12", "1" + 400 * "0")
    ):
        with pytest.raises(ConfigError, match=rf"{info.key} must be .*, got"):
            load_config(None, [f"{info.key}={text}"])
    if isinstance(info.default, float):
        with pytest.raises(ConfigError, match=rf"{info.key} must be"):
            load_config(None, [f"{info.key}=1.0e-300"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"clones": "11"},
        {"clones": 5.5},
        {"clones": True},
        {"zero_velocity": 1},
        {"calibrate_camera_imu": "all"},
    ],
)
def test_settings_built_in_python_are_checked(wrong: dict[str, object]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigError, match=rf"msckf\.{name} does not take .*; it takes"):
        MsckfSettings(**wrong)  # type: ignore[arg-type]
    assert MsckfSettings(clones=np.int64(7), pixel_sigma_px=1).clones == 7  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"dataset\.colour does not take"):
        DatasetSettings(colour="yes")  # type: ignore[arg-type]


# --- a stranger's command lines
# -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["run", "a" * 5000], "cannot use aaaa.*: File name too long"),
        (["run", "{npz}", "--out", "x" * 300], "cannot use xxx.*: File name too long"),
        (["run", "{tmp}/loop"], "loop is a link to .*, which leads nowhere"),
        (["run", "utias:{tmp}"], "it is a folder"),
        (["run", "{npz}", "--set", "msckf..clones=5"], r"and \d\d more, see vio config --all"),
        (
            ["run", "{far}"],
            "T_cam0_imu puts the camera 1e.297 km from the IMU; translations are in metres",
        ),
        (["run", "{fast}"], r"holds \[1000000000.0, 0.0, 0.0\] and"),
        (["eval", "{tmp}/huge.tum", "{tmp}/huge.tum"], "is not finite"),
        (
            ["eval", "{tmp}/est.tum", "{tmp}/est.tum", "--max-time-difference", "1e300"],
            "0 to 1e.09 s, got 1e.300 s",
        ),
    ],
    ids=lambda value: " ".join(value)[:30] if isinstance(value, list) else "",
)
def test_strange_arguments_are_one_line(
    argv: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import re

    monkeypatch.chdir(tmp_path)
    drive = ece276a_arrays(make_drive(4))
    far = drive["cam_T_imu"].copy()
    far[0, 3] = 1e300
    velocity = drive["linear_velocity"].copy()
    velocity[0] = 1e9
    files = {
        "npz": make_npz(tmp_path / "d.npz", drive),
        "far": make_npz(tmp_path / "far.npz", {**drive, "cam_T_imu": far}),
        "fast": make_npz(tmp_path / "fast.npz", {**drive, "linear_velocity": velocity}),
        "tmp": tmp_path,
    }
    (tmp_path / "loop").symlink_to("loop")
    for name, x in (("est", "1"), ("huge", "1e308")):
        (tmp_path / f"{name}.tum").write_text("".join(f"{k} {x} {k} 0 0 0 0 1\n" for k in range(5)))
    error = refused(capsys, *[part.format(**files) for part in argv])
    assert re.search(message, error), error


def test_a_header_of_zeros_is_one_line(tmp_path: Path) -> None:
    """NumPy tokenises a header that it cannot parse, as one of Python 2, and then raises an
    error of the tokenizer.
    """
    stream = io.BytesIO()
    np.save(stream, np.zeros(2, dtype=ESTIMATE))
    broken = stream.getvalue()[:50] + bytes(50) + stream.getvalue()[100:]
    (tmp_path / "a.npy").write_bytes(broken)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("ids.npy", broken)
    with pytest.raises(DataError, match=r"a\.npy: cannot be read"):
        read_estimates(tmp_path / "a.npy")
    with pytest.raises(DataError, match=r"a\.npy: is damaged"):
        check_table(tmp_path / "a.npy", ESTIMATE, 1)
    with pytest.raises(DataError, match=r"a\.npz: is damaged"):
        read_npz(tmp_path / "a.npz", ("ids",))
