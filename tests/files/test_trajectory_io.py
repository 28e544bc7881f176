"""Trajectory files and atomic writes: exact round trips, compatibility with evo, every kind of
bad file.
"""

from __future__ import annotations

import errno
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vio.errors import DataError, VioError
from vio.files.atomic import atomic_folder, atomic_write_bytes, atomic_write_text
from vio.files.trajectories import is_trajectory_file, read_trajectory, write_kitti, write_tum
from vio.geometry.lie import so3_exp
from vio.records import Trajectory

EUROC_HEADER = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z [],v_x,v_y,v_z\n"
TUM_ROW = "0 0 0 0 0 0 1"
KITTI_ROW = "1 0 0 0 0 1 0 0 0 0 1 0"

properties = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def make(
    n: int = 20, *, seed: int = 0, body: str = "imu", start_ns: int = 1_403_715_273_262_142_976
) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = so3_exp(rng.normal(size=(n, 3)))
    T[:, :3, 3] = rng.normal(size=(n, 3)) * 100
    times = start_ns + np.cumsum(rng.integers(1, 10**8, size=n))
    return Trajectory(T, times, "cam0" if body == "cam0" else "imu")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


# Round trips


@properties
@given(
    st.lists(st.integers(-(2**63) + 1, 2**63 - 1), min_size=1, max_size=8, unique=True).map(sorted),
    st.lists(st.floats(-1e9, 1e9), min_size=24, max_size=24),
)
def test_tum_round_trip_is_exact_in_time_and_position(
    tmp_path: Path, times: list[int], xyz: list[float]
) -> None:
    trajectory = replace(make(len(times)), times_ns=np.array(times, dtype=np.int64))
    trajectory.T_world_body[:, :3, 3] = np.reshape(xyz, (8, 3))[: len(times)]
    write_tum(tmp_path / "t.tum", trajectory)
    back = read_trajectory(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.times_ns, times)
    np.testing.assert_array_equal(back.positions, trajectory.positions)
    np.testing.assert_allclose(back.T_world_body, trajectory.T_world_body, rtol=0, atol=1e-15)


@pytest.mark.parametrize("body", ["imu", "cam0"])
@pytest.mark.parametrize("frames", [None, [0, 1, 2, 3], [5, 6, 9, 20], [0, 2, 4, 6]])
def test_tum_carries_body_and_frame_numbers(
    tmp_path: Path, body: str, frames: list[int] | None
) -> None:
    numbers = None if frames is None else np.array(frames, dtype=np.int64)
    trajectory = replace(make(4, body=body), frame_indices=numbers)
    write_tum(tmp_path / "t.tum", trajectory)
    back = read_trajectory(tmp_path / "t.tum")
    assert back.body == body
    if numbers is None:
        assert back.frame_indices is None
    else:
        np.testing.assert_array_equal(back.frame_indices, numbers)


def test_kitti_round_trip_is_exact(tmp_path: Path) -> None:
    trajectory = make(body="cam0")
    write_kitti(tmp_path / "t.kitti", trajectory)
    back = read_trajectory(tmp_path / "t.kitti")
    assert back.times_ns is None
    assert back.body == "cam0"
    np.testing.assert_array_equal(back.T_world_body, trajectory.T_world_body)


def test_writes_an_empty_trajectory_and_rejects_reading_it(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", replace(make(0), frame_indices=np.zeros(0, dtype=np.int64)))
    with pytest.raises(DataError, match="holds no poses"):
        read_trajectory(tmp_path / "t.tum")


@pytest.mark.parametrize(
    ("text", "expected_ns"),
    [
        ("1403715273.262142976", 1403715273262142976),
        ("1403715273.26214", 1403715273262140000),
        ("1.403715273262142976e+09", 1403715273262142976),  # as numpy.savetxt and evo write
        ("0", 0),
        ("-0.000000001", -1),
        ("12.", 12_000_000_000),
        (".5", 500_000_000),
        ("1.00000000049", 1_000_000_000),  # below a nanosecond: rounded
        ("1.0000000006", 1_000_000_001),
        ("9223372035.999999999", 9223372035999999999),
    ],
)
def test_tum_times_are_read_from_the_decimal_text(
    tmp_path: Path, text: str, expected_ns: int
) -> None:
    times = read_trajectory(write(tmp_path / "t.txt", f"{text} {TUM_ROW}\n")).times_ns
    assert times.tolist() == [expected_ns]


def test_euroc_quaternions_are_w_first_and_describe_the_imu(tmp_path: Path) -> None:
    R = Rotation.from_rotvec([0.1, -0.7, 2.0])
    x, y, z, w = R.as_quat().tolist()
    rows = [
        f"{t},1.5,-2,3,{w!r},{x!r},{y!r},{z!r},0,0,0"
        for t in (1403715273262142976, 1403715273267143168)
    ]
    trajectory = read_trajectory(write(tmp_path / "data.csv", EUROC_HEADER + "\r\n".join(rows)))
    assert trajectory.body == "imu"
    assert trajectory.times_ns.tolist() == [1403715273262142976, 1403715273267143168]
    np.testing.assert_allclose(trajectory.T_world_body[1, :3, :3], R.as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(trajectory.positions[0], [1.5, -2, 3])


@pytest.mark.parametrize(
    "text", [f"1 {TUM_ROW}\n", f"\ufeff1 {TUM_ROW}", f"  1\t{TUM_ROW}  \n\n", f"# x\n\n1 {TUM_ROW}"]
)
def test_accepts_bom_tabs_blank_lines_and_comments(tmp_path: Path, text: str) -> None:
    assert len(read_trajectory(write(tmp_path / "t.txt", text))) == 1


# The body


def test_the_body_argument_overrides_the_file_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / "t.txt", f"# body: cam0\n1 {TUM_ROW}\n")
    assert read_trajectory(path).body == "cam0"
    assert read_trajectory(path, body="cam0").body == "cam0"
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        assert read_trajectory(path, body="imu").body == "imu"
    assert "describes cam0 according to its comment" in caplog.text
    assert read_trajectory(write(tmp_path / "k.txt", KITTI_ROW), body="imu").body == "imu"


def test_rejects_writing_imu_poses_as_kitti(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"in_cam0 first"):
        write_kitti(tmp_path / "t.kitti", make(body="imu"))
    assert not list(tmp_path.iterdir())


def test_kitti_form_warns_when_rows_are_not_frames(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_kitti(tmp_path / "a", replace(make(3, body="cam0"), frame_indices=np.arange(3)))
    assert not caplog.records
    write_kitti(tmp_path / "b", replace(make(3, body="cam0"), frame_indices=np.array([10, 11, 13])))
    assert "frames 10-11 13-13" in caplog.text
    caplog.clear()
    write_kitti(tmp_path / "c", replace(make(3, body="cam0"), frame_indices=np.array([0, 2, 4])))
    assert "the frames 0-4/2;" in caplog.text
    caplog.clear()
    irregular = np.cumsum(np.tile([1, 1, 2], 30))
    write_kitti(tmp_path / "d", replace(make(90, body="cam0"), frame_indices=irregular))
    assert "the frames 1 to 120 with gaps, 90 in all;" in caplog.text


@pytest.mark.parametrize("steps", [[2], [1], [3, 3, 2], [1, 2, 1, 5], [2, 2, 1]])
def test_frame_numbers_come_back(steps: list[int], tmp_path: Path) -> None:
    """As comments of any length before the first row, and such a file is told from others by its
    first row.
    """
    frames = np.cumsum(np.resize(steps, 4000))
    trajectory = replace(make(4000), frame_indices=frames)
    write_tum(tmp_path / "t.tum", trajectory)
    assert is_trajectory_file(tmp_path / "t.tum")
    again = read_trajectory(tmp_path / "t.tum").frame_indices
    np.testing.assert_array_equal(again, frames)


def test_tum_form_needs_times(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="needs times"):
        write_tum(tmp_path / "t.tum", replace(make(), times_ns=None))


# Rotations


def test_rounded_rotations_are_made_orthonormal(tmp_path: Path) -> None:
    R = so3_exp([0.5, -0.2, 0.9])
    row = " ".join(f"{v:.4f}" for v in np.column_stack([R, [1, 2, 3]]).ravel())
    back = read_trajectory(write(tmp_path / "k.txt", row)).T_world_body[0, :3, :3]
    np.testing.assert_allclose(back @ back.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(back, R, atol=1e-4)


def test_a_rounded_quaternion_is_normalised(tmp_path: Path) -> None:
    path = write(tmp_path / "t.txt", "1 0 0 0 -0.8242 -0.1069 -0.5517 0.0694\n")
    R = read_trajectory(path).T_world_body[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)


# Bad input: each message names the file, the line and what to do

BAD = {
    "nan": (f"1 {TUM_ROW}\n2 nan 0 0 0 0 0 1\n", None, "line 2: a pose is not finite.*remove"),
    "infinite": (f"1 {TUM_ROW}\n2 0 inf 0 0 0 0 1\n", None, "line 2: a pose is not finite"),
    "text": (
        f"1 {TUM_ROW}\n2 0 0 zero 0 0 0 1\n",
        None,
        "line 2: could not convert.*'zero'.*numbers",
    ),
    "missing column": (
        f"1 {TUM_ROW}\n2 0 0 0 0 0 1\n",
        None,
        "line 2: 7 columns instead of 8; tum form has",
    ),
    "unknown form": ("1 2 3\n", None, "line 1: 3 columns fit no known format.*tum.*kitti.*euroc"),
    "comments count": (
        f"# one\n\n1 {TUM_ROW}\n# four\n1.5 0 0 0 0 0 1\n",
        None,
        "line 5: 7 columns",
    ),
    "time repeats": (f"1 {TUM_ROW}\n1.0 {TUM_ROW}\n", None, "line 2: the clock repeats.*reorder"),
    "time backwards": (
        f"2 {TUM_ROW}\n1 {TUM_ROW}\n",
        None,
        "line 2: the clock runs backwards.*reorder",
    ),
    "time not a number": (f"one {TUM_ROW}\n", None, "line 1: 'one' is no time"),
    "time nan": (f"nan {TUM_ROW}\n", None, "line 1: 'nan' is no time"),
    "time huge": (f"1e999999999 {TUM_ROW}\n", None, "line 1: .* is out of range for a time"),
    "time beyond its unit": (
        f"# time [s] tx ty tz qx qy qz qw\n1403715273262142976 {TUM_ROW}\n",
        None,
        "is out of range for a time; divide nanoseconds by 1e9",
    ),
    "quaternion norm": (
        f"1 {TUM_ROW}\n2 0 0 0 0 0 0 1.1\n",
        None,
        "line 2: the quaternion has norm 1.1.*column order",
    ),
    "quaternion small": ("1 0 0 0 0 0 0 0.5\n", None, "line 1: the quaternion has norm 0.5, not 1"),
    "quaternion huge": ("1 0 0 0 0 0 0 1e300\n", None, "line 1: a pose is not finite, or beyond"),
    "unknown body": (
        f"# body: left_wing\n1 {TUM_ROW}\n",
        None,
        "names the body 'left_wing'; use '# body: imu'",
    ),
    "frames: too many": (
        f"# frames: 0-999999999\n1 {TUM_ROW}\n",
        None,
        "does not number its 1 poses",
    ),
    "frames: text": (f"# frames: all\n1 {TUM_ROW}\n", None, "does not number its 1 poses"),
    "frames: backwards": (
        f"# frames: 5-5 2-2\n1 {TUM_ROW}\n2 {TUM_ROW}\n",
        None,
        "does not number its 2 poses",
    ),
    "kitti not orthonormal": (
        f"{KITTI_ROW}\n1.01 0 0 0 0 1 0 0 0 0 1 0\n",
        None,
        "line 2: .*off orthonormal by 0.02",
    ),
    "kitti mirrored": ("1 0 0 0 0 1 0 0 0 0 -1 0\n", None, "line 1: the rotation mirrors"),
    "kitti huge": (
        "1e300 0 0 0 0 1 0 0 0 0 1 0\n",
        None,
        "line 1: a pose is not finite, or beyond",
    ),
    "kitti nan": (
        f"{KITTI_ROW}\nnan 0 0 0 0 1 0 0 0 0 1 0\n",
        None,
        "line 2: a pose is not finite",
    ),
    "kitti columns": (f"{KITTI_ROW}\n1 2 3\n", None, "line 2: 3 columns instead of 12"),
    "euroc columns": (f"{EUROC_HEADER}1,2,3\n", None, "line 2: 3 columns instead of 8"),
    "euroc uneven": (
        f"{EUROC_HEADER}1,0,0,0,1,0,0,0\n2,0,0,0,1,0,0\n",
        None,
        "line 3: 7 columns instead of 8",
    ),
    "euroc seconds": (
        f"{EUROC_HEADER}1.5,0,0,0,1,0,0,0\n",
        None,
        "line 2: '1.5' is no time in whole nanoseconds",
    ),
    "euroc overflow": (
        f"{EUROC_HEADER}9223372036854775808,0,0,0,1,0,0,0\n",
        None,
        "is no time in whole nanoseconds",
    ),
    "euroc quaternion": (
        f"{EUROC_HEADER}1,0,0,0,2,0,0,0\n",
        None,
        "line 2: the quaternion has norm 2",
    ),
    "empty": ("", None, "holds no poses"),
    "only comments": ("# timestamp\n", None, "holds no poses"),
    "requested tum": (KITTI_ROW, "tum", "line 1: 12 columns instead of 8; tum form"),
    "requested kitti": (f"1 {TUM_ROW}", "kitti", "line 1: 8 columns instead of 12; kitti form"),
    "requested euroc": ("1 2 3", "euroc", "line 1: 3 columns instead of 8; euroc form"),
    "requested nonsense": (
        "1 2 3",
        "csv",
        "unknown trajectory format 'csv'; choose one of tum, kitti, euroc",
    ),
}


@pytest.mark.parametrize("name", list(BAD))
def test_rejects_bad_trajectory_files_with_one_line_error(tmp_path: Path, name: str) -> None:
    text, fmt, match = BAD[name]
    path = write(tmp_path / "bad.txt", text)
    with pytest.raises(DataError, match=match) as caught:
        read_trajectory(path, fmt=fmt)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    if name != "requested nonsense":
        assert str(path) in str(caught.value)


def test_rejects_missing_folder_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot read .*missing\.txt: No such file"):
        read_trajectory(tmp_path / "missing.txt")
    with pytest.raises(DataError, match=r"is a folder; give one file of all poses"):
        read_trajectory(tmp_path)
    (tmp_path / "b").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(DataError, match="b: not a text file"):
        read_trajectory(tmp_path / "b")


# Other programs and real files


def test_evo_reads_written_files(tmp_path: Path) -> None:
    from evo.tools import file_interface

    trajectory = replace(make(50, body="cam0"), frame_indices=np.arange(3, 53))
    write_tum(tmp_path / "t.tum", trajectory)
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(tum.timestamps, trajectory.times_ns / 1e9, rtol=1e-15)
    np.testing.assert_allclose(tum.poses_se3, trajectory.T_world_body, atol=1e-14)
    write_kitti(tmp_path / "t.kitti", replace(trajectory, frame_indices=None))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "t.kitti"))
    np.testing.assert_array_equal(kitti.poses_se3, trajectory.T_world_body)


def test_reads_files_written_by_evo(tmp_path: Path) -> None:
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface

    trajectory = make(50, start_ns=0)
    theirs = PoseTrajectory3D(
        poses_se3=list(trajectory.T_world_body), timestamps=trajectory.times_ns / 1e9
    )
    file_interface.write_tum_trajectory_file(str(tmp_path / "t.tum"), theirs)
    file_interface.write_kitti_poses_file(str(tmp_path / "t.kitti"), theirs)
    tum, kitti = read_trajectory(tmp_path / "t.tum"), read_trajectory(tmp_path / "t.kitti")
    np.testing.assert_array_equal(tum.times_ns, trajectory.times_ns)
    np.testing.assert_allclose(tum.T_world_body, trajectory.T_world_body, atol=1e-13)
    np.testing.assert_allclose(kitti.T_world_body, trajectory.T_world_body, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "poses", "body"),
    [
        ("kitti_0039/poses.txt", 110, "cam0"),
        ("kitti_06_head/poses.txt", 30, "cam0"),
        ("ece276a/kitti_odometry_07_poses.txt", 1101, "cam0"),
        ("euroc/V1_01_keyframes/groundtruth_tum.txt", 2895, "imu"),
    ],
)
def test_real_ground_truth_survives_a_round_trip(
    tmp_path: Path, data_dir: Path, name: str, poses: int, body: str
) -> None:
    trajectory = read_trajectory(data_dir / name)
    assert len(trajectory) == poses
    assert trajectory.body == body
    (write_kitti if trajectory.times_ns is None else write_tum)(tmp_path / "copy", trajectory)
    copy = read_trajectory(tmp_path / "copy")
    np.testing.assert_allclose(copy.T_world_body, trajectory.T_world_body, atol=1e-14)
    np.testing.assert_array_equal(copy.positions, trajectory.positions)
    if trajectory.times_ns is not None:
        np.testing.assert_array_equal(copy.times_ns, trajectory.times_ns)
        assert trajectory.times_ns[0] == 1403715273262140000


# Atomic writes


def test_atomic_write_replaces_whole_files_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    atomic_write_text(path, "één\n")
    atomic_write_bytes(path, b"twee\r\n")
    assert path.read_bytes() == b"twee\r\n"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.txt", "old")

    def full_disk(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("vio.files.atomic.os.fsync", full_disk)
    with pytest.raises(DataError, match=r"cannot write .*a\.txt: No space left on device; choose"):
        atomic_write_text(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_writing_into_a_missing_folder_or_over_a_folder_is_a_data_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot write .*No such file"):
        atomic_write_text(tmp_path / "none" / "a.txt", "x")
    (tmp_path / "d").mkdir()
    with pytest.raises(DataError, match=r"cannot write .*directory"):
        atomic_write_text(tmp_path / "d", "x")
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


def test_atomic_folder_appears_at_the_end_with_ordinary_permissions(tmp_path: Path) -> None:
    target = tmp_path / "new" / "run"
    with atomic_folder(target, replace=False) as inside:
        (inside / "a").write_text("x")
        assert not target.exists()
        assert inside.parent == target.parent
    assert [p.name for p in target.iterdir()] == ["a"]
    assert [p.name for p in target.parent.iterdir()] == ["run"]
    (tmp_path / "plain").mkdir()
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode


def fill(
    target: Path, text: str, *, replace: bool = False, error: BaseException | None = None
) -> None:
    """Make a folder whose marker holds `text`, and fail half-way if requested."""
    with atomic_folder(target, replace=replace, marker="m") as inside:
        (inside / "m").write_text(text)
        if error is not None:
            raise error
        (inside / text).write_text("")


@pytest.mark.parametrize(
    "error", [ValueError("boom"), KeyboardInterrupt("boom"), SystemExit("boom")]
)
def test_a_failure_inside_leaves_no_folder(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error), match="boom"):
        fill(tmp_path / "x" / "y" / "run", "new", error=error)
    assert not list(tmp_path.iterdir())


def test_a_failure_inside_keeps_the_old_folder(tmp_path: Path) -> None:
    fill(tmp_path / "run", "old")
    with pytest.raises(ValueError, match="boom"):
        fill(tmp_path / "run", "new", replace=True, error=ValueError("boom"))
    assert (tmp_path / "run" / "m").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_full_disk_inside_is_a_data_error_and_other_os_errors_pass(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot write .*run: full; choose"):
        fill(tmp_path / "run", "new", error=OSError(errno.ENOSPC, "full"))
    with pytest.raises(FileNotFoundError):
        fill(tmp_path / "run", "new", error=FileNotFoundError(errno.ENOENT, "gone"))
    assert not list(tmp_path.iterdir())


def test_replacing_swaps_the_whole_folder(tmp_path: Path) -> None:
    fill(tmp_path / "run", "first", replace=True)
    fill(tmp_path / "run", "second", replace=True)
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == ["m", "second"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_failed_swap_puts_the_old_folder_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path / "run", "old")
    rename = Path.rename

    def fail_for_new(self: Path, to: Path) -> Path:
        if self.name.endswith(".partial"):
            raise OSError(errno.EIO, "broken")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", fail_for_new)
    with pytest.raises(DataError, match=r"cannot write .*broken"):
        fill(tmp_path / "run", "new", replace=True)
    assert (tmp_path / "run" / "m").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_never_replaces_foreign_files(tmp_path: Path) -> None:
    theirs = tmp_path / "photos"
    theirs.mkdir()
    (theirs / "holiday.jpg").write_text("x")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(theirs)
    cases = [
        (theirs, False, "exists already; choose another path"),
        (theirs, True, r"was not made by this program \(it has no m\)"),
        (tmp_path / "file", True, "is not a folder"),
        (tmp_path / "link", True, "is not a folder"),
    ]
    for path, replaced, match in cases:
        with (
            pytest.raises(VioError, match=match),
            atomic_folder(path, replace=replaced, marker="m"),
        ):
            raise AssertionError("must not be entered")
    with (
        pytest.raises(VioError, match="was not made by this program"),
        atomic_folder(theirs, replace=True),
    ):
        raise AssertionError("must not be entered")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "link", "photos"]
    assert (theirs / "holiday.jpg").exists()


def test_an_empty_folder_may_be_replaced(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with atomic_folder(tmp_path / "run", replace=True, marker="m") as inside:
        (inside / "a").write_text("x")
    assert (tmp_path / "run" / "a").exists()


def test_a_folder_created_meanwhile_is_kept(tmp_path: Path) -> None:
    inside = atomic_folder(tmp_path / "run", replace=False)
    inside.__enter__()
    fill(tmp_path / "run", "theirs")
    with pytest.raises(VioError, match="exists already"):
        inside.__exit__(None, None, None)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert (tmp_path / "run" / "m").read_text() == "theirs"
