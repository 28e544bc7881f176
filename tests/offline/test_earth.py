"""A trajectory on the earth: geodesy against PROJ, fusion with simulated GNSS, readers, and
`vio georeference`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.bag_maker import Script
from tests.commands import json_of, refused
from tests.jacobians import numeric_jacobian
from tests.mapping.test_map_store import CAMERA, _features, _row
from vio.cli import main
from vio.datasets.gnss import read_gnss
from vio.datasets.gnss_fixes import SIGMA_M, GnssFixes, checked_fixes
from vio.earth.alignment import Georeference, _Problem, georeference, heading_deg, places_between
from vio.earth.alignment import Path as GraphPath
from vio.earth.clock import clock_doubt
from vio.earth.exports import write_utm
from vio.earth.geodesy import LocalFrame, ecef, geodetic_of, utm, utm_zone
from vio.errors import DataError, EstimationError
from vio.files.trajectories import read_trajectory, write_tum
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.mapping.files import describe_map, extract_map
from vio.mapping.map_store import MapStore, SessionRow
from vio.offline.georeference import placed
from vio.records import Estimate, LoopEvent, MapKeyframes, Trajectory
from vio.runs.mapped import write_keyframes
from vio.runs.tables import estimate_row

ORIGIN = np.array([49.0, 8.4, 115.0])
LEVER_M = np.array([1.0, 0.5, 1.5])
YAW_RAD = 1.234
SIGMA = 2.0  # m, of each axis


@pytest.mark.parametrize(
    ("geodetic", "earth_centred", "zone", "grid"),
    [  # by PROJ 9.5
        (
            (49.01, 8.43, 112.0),
            (4146381.0132, 614502.8304, 4791372.8167),
            32,
            (458317.2031, 5428723.9409),
        ),
        (
            (-33.86, 151.2, 40.0),
            (-4646142.5241, 2554238.4674, -3533584.1652),
            56,
            (333491.2299, 6251909.206),
        ),
        (
            (78.2, 15.6, 500.0),
            (1260403.6833, 351911.0315, 6222030.3055),
            33,
            (513696.9454, 8680760.0532),
        ),
    ],
)
def test_geodesy_agrees_with_proj(
    geodetic: tuple[float, ...],
    earth_centred: tuple[float, ...],
    zone: int,
    grid: tuple[float, ...],
) -> None:
    g = np.array([geodetic])
    np.testing.assert_allclose(ecef(g)[0], earth_centred, atol=1e-4)
    np.testing.assert_allclose(geodetic_of(ecef(g)), g, atol=1e-9)
    assert utm_zone(g[0]) == zone
    np.testing.assert_allclose(utm(g, zone)[0], grid, atol=1e-3)
    frame = LocalFrame(ORIGIN)
    near = np.array([[100.0, -40.0, 3.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(frame.enu(frame.geodetic(near)), near, atol=1e-8)


@dataclass(frozen=True)
class Drive:
    """A kilometre at 10 m/s with odometry that drifts, and GNSS every second."""

    path: GraphPath
    T_enu: FloatArray  # truth at ORIGIN
    fixes: GnssFixes

    def error_m(self, found: Georeference) -> FloatArray:
        truth = found.frame.enu(LocalFrame(ORIGIN).geodetic(self.T_enu[:, :3, 3]))
        return found.T_enu_body[:, :3, 3] - truth


# first and last position, and what is added to them
Jump = tuple[int, int, tuple[float, float, float]]


def _drive(*, seed: int, poses: int = 1000, jumps: Sequence[Jump] = ()) -> Drive:
    """Errors of GNSS last five seconds; `jumps` are added."""
    rng = np.random.default_rng(seed)
    turn = np.array(
        [
            (np.pi / 32) * (1 if (k // 250) % 2 else -1) * (60 < k % 250 < 76)
            for k in range(poses - 1)
        ]
    )
    true, odometry = [se3_from_parts(so3_exp(np.array([0, 0, YAW_RAD])), np.zeros(3))], [np.eye(4)]
    for w in turn:
        step = se3_exp(np.array([1.0, 0, 0, 0, 0, w]))
        true.append(true[-1] @ step)
        step[:3, 3] *= 1.005
        noise = np.concatenate(
            [0.01 * rng.normal(size=3), np.radians([5e-4, 5e-4, 0.03]) * rng.normal(size=3)]
        )
        odometry.append(odometry[-1] @ step @ se3_exp(noise))
    T = np.array(true)
    rows = np.arange(0, poses, 10)
    noise = np.empty((len(rows), 3))
    noise[0] = SIGMA * rng.normal(size=3)
    keep = np.exp(-1 / 5)
    for k in range(1, len(rows)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1 - keep**2) * SIGMA * rng.normal(size=3)
    for begin, end, off in jumps:
        noise[begin:end] += off
    times_ns = np.arange(poses) * 10**8
    antenna = T[rows, :3, :3] @ LEVER_M + T[rows, :3, 3] + noise
    C = np.tile(SIGMA**2 * np.eye(3), (len(rows), 1, 1))
    fixes = checked_fixes(times_ns[rows], LocalFrame(ORIGIN).geodetic(antenna), C, "simulated")
    none = np.zeros(0, dtype=np.int64)
    up = np.array([0, 0, 1.0])
    return Drive(
        GraphPath(times_ns, np.array(odometry), none, none, up, np.radians(0.3), none), T, fixes
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("jumps", "refused", "heights"),
    [
        ((), 0, 100),
        (((30, 45, (40.0, 40.0, 0.0)), (70, 75, (-25.0, 0.0, 0.0))), 20, 100),
        (((80, 100, (0.0, 30.0, 0.0)),), 20, 100),
        (((60, 100, (0.0, 0.0, 30.0)),), 0, 60),
    ],
    ids=["clean", "jumps", "a jump to the end", "wrong height"],
)
def test_a_kilometre_is_as_good_as_its_gnss(
    jumps: Sequence[Jump], refused: int, heights: int, seed: int
) -> None:
    drive = _drive(seed=seed, jumps=jumps)
    found = georeference(drive.path, drive.fixes, LEVER_M)
    error = drive.error_m(found)
    horizontal = np.linalg.norm(error[:, :2], axis=1)
    assert np.sqrt(np.mean(horizontal**2)) < np.sqrt(2) * SIGMA
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < SIGMA
    assert (int((~found.used).sum()), int(found.used_height.sum())) == (refused, heights)
    heading = np.arctan2(found.T_enu_body[500, 1, 0], found.T_enu_body[500, 0, 0])
    true = np.arctan2(drive.T_enu[500, 1, 0], drive.T_enu[500, 0, 0])
    assert abs(np.degrees(heading - true)) < 1.0
    assert abs(found.scale - 1 / 1.005) < 3 * found.scale_sigma
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.position_covariance), error) / 3
    assert 0.1 < np.mean(nees) < 3.0


def test_an_outage_is_bridged_by_the_odometry() -> None:
    drive = _drive(seed=0)
    kept = np.r_[0:20, 70:100]
    f = drive.fixes
    fixes = GnssFixes(f.times_ns[kept], f.geodetic[kept], f.covariance[kept], f.has_height[kept])
    found = georeference(drive.path, fixes, LEVER_M)
    sigma = np.sqrt(np.trace(found.position_covariance[:, :2, :2], axis1=1, axis2=2))
    assert np.linalg.norm(drive.error_m(found)[:, :2], axis=1).max() < 2 * SIGMA
    assert sigma[450] > sigma[100]


def test_without_a_fix_in_height_the_place_is_still_found() -> None:
    drive = _drive(seed=1)
    flat = drive.fixes.geodetic.copy()
    flat[:, 2] = np.nan
    fixes = checked_fixes(drive.fixes.times_ns, flat, drive.fixes.covariance, "simulated")
    assert not fixes.has_height.any()
    found = georeference(drive.path, fixes, LEVER_M)
    assert not found.used_height.any()
    assert np.linalg.norm(drive.error_m(found)[:, :2], axis=1).max() < 2 * SIGMA


def test_covariance_of_the_rigid_transform_covers_it() -> None:
    found = [
        georeference(d.path, d.fixes, LEVER_M)
        for d in (_drive(seed=s, poses=300) for s in range(8))
    ]
    exact = _drive(seed=0, poses=300).T_enu[0]
    headings = [
        np.arctan2(f.T_enu_map[1, 0], f.T_enu_map[0, 0]) - np.arctan2(exact[1, 0], exact[0, 0])
        for f in found
    ]
    sigmas = np.array([heading_deg(f.T_enu_map, f.covariance)[1] for f in found])
    assert 0.3 < np.sqrt(np.mean((np.degrees(headings) / sigmas) ** 2)) < 2.5


def test_normal_matrix_is_the_jacobian_of_the_gradient_without_residuals() -> None:
    drive = _drive(seed=3, poses=24)
    path = replace(drive.path, first=np.array([1]), second=np.array([20]))
    before, share, _ = places_between(path, drive.fixes.times_ns)
    C, has_height = drive.fixes.covariance, drive.fixes.has_height
    nowhere = np.zeros((len(C), 3))
    measured = _Problem(path, before, share, nowhere, C, has_height, LEVER_M).antenna(
        path.T_map_body
    )
    problem, weight = (
        _Problem(path, before, share, measured, C, has_height, LEVER_M),
        np.ones((len(C), 2)),
    )
    H, g = problem._normal(path.T_map_body, 0.0, weight)
    assert np.abs(g).max() < 1e-6

    def gradient(x: FloatArray) -> FloatArray:
        return problem._normal(
            path.T_map_body @ se3_exp(x[:-1].reshape(-1, 6)), float(x[-1]), weight
        )[1]

    numeric = -numeric_jacobian(gradient, np.zeros(len(g)))
    scale = np.sqrt(np.outer(H.diagonal(), H.diagonal()))
    assert (np.abs(numeric - H.toarray()) / scale).max() < 1e-3


def test_too_few_positions_are_refused_with_both_spans() -> None:
    drive = _drive(seed=0, poses=100)
    with pytest.raises(
        EstimationError, match=r"only 0 GNSS positions .* are within the trajectory .*--time-offset"
    ):
        georeference(drive.path, drive.fixes, LEVER_M, time_offset_ns=10**12)


# --- readers
# --------------------------------------------------------------------------------------------------


def _csv(path: Path, fixes: GnssFixes, *, sigmas: bool = True, offset_s: float = 0.0) -> Path:
    rows = []
    for t, g, C in zip(
        fixes.times_ns.tolist(), fixes.geodetic.tolist(), fixes.covariance, strict=True
    ):
        values = [t * 1e-9 + offset_s, *g, *(np.sqrt(np.diag(C)).tolist() if sigmas else [])]
        rows.append(",".join(f"{v:.9f}" for v in values))
    names = (
        "time_s,latitude_deg,longitude_deg,height_m"
        + ",sigma_east_m,sigma_north_m,sigma_up_m" * sigmas
    )
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def test_reads_a_table_with_and_without_covariance(tmp_path: Path) -> None:
    fixes = _drive(seed=0, poses=100).fixes
    full, plain = (read_gnss(_csv(tmp_path / f"{s}.csv", fixes, sigmas=s)) for s in (True, False))
    np.testing.assert_allclose(full.geodetic, fixes.geodetic, atol=1e-8)
    np.testing.assert_allclose(full.covariance, fixes.covariance, atol=1e-3)
    np.testing.assert_allclose(plain.covariance[:, 0, 0], SIGMA_M**2, atol=1e-3)
    assert any("state no covariance" in note for note in plain.notes)


def test_rows_without_a_position_are_skipped_and_counted(tmp_path: Path) -> None:
    file = _csv(tmp_path / "a.csv", _drive(seed=0, poses=100).fixes)
    lines = file.read_text().splitlines()
    lines[3] = lines[3].split(",")[0] + ",nan,nan,nan,,,"
    file.write_text("\n".join(lines))
    fixes = read_gnss(file)
    assert len(fixes) == 9
    assert "1 of 10 rows" in fixes.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "time_s,latitude_deg,longitude_deg,height_m\n0,458317.2,5428723.9,100\n",
            "no latitude and longitude in degrees",
        ),
        ("time_s,east_m,north_m,up_m\n0,1,2,3\n", "has the columns time_s,east_m"),
        ("0,49,8\n", "3 values instead of 7"),
        ("0,49,8,1\n1,nan,nan,1,2\n", "line 1"),
        ("0,nan,nan,1\n", "holds no position"),
        ("0,0,0,0\n", "holds no position"),
        ("0,489800000,83900000,115000\n", "divide receivers' 1e-7 degrees"),
        ("time,easting,northing,alt\n0,49,8,1\n", "has the columns time,easting"),
        ("", "holds no line of data"),
    ],
)
def test_damaged_tables_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_gnss(tmp_path / "a.csv")


@pytest.mark.parametrize(("unit", "step"), [(1e3, 1000), (1e6, 200_000), (1e9, 10**8)])
def test_stamps_in_other_units_are_read(tmp_path: Path, unit: float, step: int) -> None:
    (tmp_path / "a.csv").write_text("".join(f"{step * k},49,8,1\n" for k in range(20)))
    fixes = read_gnss(tmp_path / "a.csv")
    assert fixes.times_ns[1] == round(1e9 * step / unit)
    assert [note for note in fixes.notes if "its times are taken for" in note]


def test_a_header_may_name_longitude_first_and_zeros_are_no_fix(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("stamp,lng,lat,alt\n0,0,0,0\n1,8,49,2\n2,8,49.1,2\n")
    fixes = read_gnss(tmp_path / "a.csv")
    assert fixes.geodetic.tolist() == [[49, 8, 2], [49.1, 8, 2]]
    assert fixes.notes[0].startswith("1 of 3 rows without a position")


def test_positions_of_another_extent_are_refused() -> None:
    drive = _drive(seed=0, poses=300)
    fixes = drive.fixes
    for geodetic, words in (
        (np.radians(fixes.geodetic), "in radians"),
        (fixes.geodetic[:, [1, 0, 2]] * [1, 3, 1], "latitude before longitude"),
        (np.tile(fixes.geodetic[:1], (len(fixes), 1)), "those of this drive"),
    ):
        with pytest.raises(EstimationError, match=words):
            georeference(drive.path, replace(fixes, geodetic=geodetic), LEVER_M)


_REVERSED_NORTH = np.diag([1.0, -1.0, 1.0])
_SWAPPED = np.eye(3)[[1, 0, 2]]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("precise", [False, True])
@pytest.mark.parametrize("hand", [_REVERSED_NORTH, _SWAPPED], ids=["north reversed", "swapped"])
def test_mirrored_positions_are_named(hand: FloatArray, precise: bool, seed: int) -> None:
    """As those of CARLA 0.9.16, whose latitudes rise to the south (finding F118)."""
    drive = _drive(seed=seed)
    fixes = _precise(drive) if precise else drive.fixes
    frame = LocalFrame(ORIGIN)
    mirrored = replace(
        fixes,
        geodetic=frame.geodetic(frame.enu(fixes.geodetic) @ hand.T),
        covariance=hand @ fixes.covariance @ hand.T,
    )
    with pytest.raises(EstimationError, match="the GNSS positions are mirrored: "):
        georeference(drive.path, mirrored, LEVER_M)


def test_positions_that_agree_by_no_mirror_are_not_called_mirrored() -> None:
    jumps = tuple(
        (k, k + 7, (60.0 * (-1) ** k, 45.0 * (-1) ** (k // 2), 0.0)) for k in range(0, 98, 7)
    )
    drive = _drive(seed=0, jumps=jumps)
    with pytest.raises(EstimationError, match=r"^only \d+ of 100 GNSS positions agree"):
        georeference(drive.path, drive.fixes, LEVER_M)


def test_clocks_that_usual_differences_explain_are_named() -> None:
    drive = _drive(seed=0, poses=100)
    with pytest.raises(EstimationError, match="18 s \\(GPS time and UTC\\)"):
        georeference(drive.path, drive.fixes, LEVER_M, time_offset_ns=18 * 10**9)


def test_reads_kitti_oxts(tmp_path: Path) -> None:
    data = tmp_path / "drive" / "oxts" / "data"
    data.mkdir(parents=True)
    for k in range(4):
        values = [49.0 + 1e-5 * k, 8.4, 115.0, *[0.0] * 20, 0.05, *[0.0] * 6]
        (data / f"{k:010d}.txt").write_text(" ".join(f"{v:.9f}" for v in values) + "\n")
    stamps = "".join(f"2011-09-26 13:02:2{k}.500000000\n" for k in range(4))
    (data.parent / "timestamps.txt").write_text(stamps)
    fixes = read_gnss(tmp_path / "drive")
    assert np.diff(fixes.times_ns).tolist() == [10**9] * 3
    np.testing.assert_allclose(fixes.geodetic[3], [49.00003, 8.4, 115.0])
    assert fixes.covariance[0, 0, 0] == pytest.approx(0.05**2, abs=2e-4)
    (data / "0000000002.txt").write_text("1 2 3\n")
    with pytest.raises(DataError, match=r"0000000002.txt: has 3 values, not the 30"):
        read_gnss(tmp_path / "drive")


def _navsat(script: Script, time_ns: int, status: int, kind: int) -> None:
    name = "sensor_msgs/msg/NavSatFix"
    state = script.make("sensor_msgs/msg/NavSatStatus", status, 1)
    C = np.diag([1.0, 4.0, 9.0]).ravel()
    values = (49.0 + 1e-13 * time_ns, 8.4, 115.0, C, kind)
    script.add(
        "/fix", name, time_ns, script.make(name, script.header(time_ns, "gps"), state, *values)
    )


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_reads_navsatfix_of_a_bag(tmp_path: Path, storage: str) -> None:
    script = Script(storage)
    for k in range(5):
        _navsat(script, (k + 1) * 10**9, -1 if k == 2 else 0, 0 if k == 3 else 2)
    path = script.write(tmp_path / ("a.bag" if storage == "bag" else "a"))
    fixes = read_gnss(path)
    assert fixes.times_ns.tolist() == [10**9, 2 * 10**9, 4 * 10**9, 5 * 10**9]
    np.testing.assert_allclose(np.diag(fixes.covariance[0]), [1, 4, 9], atol=1e-3)
    assert fixes.covariance[2, 0, 0] == pytest.approx(SIGMA_M**2, abs=1e-3)
    assert any("no fix" in note for note in fixes.notes)
    with pytest.raises(DataError, match="topics of NavSatFix: none"):
        read_gnss(path, "/other")


# --- the command
# --------------------------------------------------------------------------------------------------


def _map_of(path: Path, drive: Drive, up_map: FloatArray | None = None) -> Path:
    """Write a map with a keyframe every second of a drive, in its frame; `up_map` (3,) is the
    vertical, if known.
    """
    store = MapStore(path, create=True)
    store.add_session(SessionRow("a drive", CAMERA, True, 0))
    for k in range(0, len(drive.T_enu), 10):
        T = drive.path.T_map_body[k]
        up = None if up_map is None else T[:3, :3].T @ up_map
        row = replace(_row(1), frame=k, time_ns=int(drive.path.times_ns[k]), T_map_cam=T, up_cam=up)
        store.add_keyframe(row, _features(k))
    store.close()
    return path


def _keep_earth(file: Path, of: Path) -> None:
    """Place a map where another one is."""
    with closing(MapStore(file)) as store, closing(MapStore(of, read_only=True)) as other:
        earth = other.earth()
        assert earth is not None
        store.set_earth(earth)


def test_places_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = _drive(seed=0, poses=300)
    file, gnss = _map_of(tmp_path / "a.map", drive), _csv(tmp_path / "gnss.csv", drive.fixes)
    before = describe_map(file)
    assert main(["georeference", str(file), str(gnss), "--lever-arm", "1,0.5,1.5"]) == 0
    assert "positions used" in capsys.readouterr().out
    saved = json.loads((tmp_path / "a.map.earth" / "earth.json").read_text())
    assert abs(saved["heading_deg"] - np.degrees(YAW_RAD)) < 5
    assert saved["sigma_horizontal_m"] < np.sqrt(2) * SIGMA
    after = describe_map(file)
    assert after["earth"]["T_enu_map"] == saved["T_enu_map"]
    assert {**after, "earth": None, "bytes": 0} == {**before, "bytes": 0}
    run = tmp_path / "run"  # in the frame of the map
    run.mkdir()
    track = Trajectory(
        drive.path.T_map_body, drive.path.times_ns, "imu", frame_indices=np.arange(300)
    )
    for name in ("trajectory.tum", "map_trajectory.tum"):
        write_tum(run / name, track)
    (run / "landmarks.ply").write_bytes(b"ply\nend_header\n")
    metrics = {"T_cam0_imu": np.eye(4).tolist(), "motion": "imu", "map": {"joined": True}}
    (run / "metrics.json").write_text(json.dumps(metrics))
    own, T = np.arange(0, 300, 10), drive.path.T_map_body
    write_keyframes(
        run,
        MapKeyframes(
            own // 10, own, drive.path.times_ns[own], own < 0, T[own], np.zeros((30, 6, 6))
        ),
    )
    assert main(["georeference", str(run), str(file)]) == 0
    assert "GNSS" not in capsys.readouterr().out
    placed_run = read_trajectory(run / "earth" / "trajectory_enu.tum").T_world_body
    np.testing.assert_allclose(
        placed_run, np.array(saved["T_enu_map"]) @ track.T_world_body, atol=1e-5
    )
    extract_map(file, tmp_path / "part.map", tuple(drive.path.T_map_body[0, :3, 3]), 50.0)
    assert describe_map(tmp_path / "part.map")["earth"] == after["earth"]
    # The same map in another frame, as of a merge, and a map of another path with the same frames
    # and times.
    moved, other = se3_exp([40.0, -7.0, 2.0, 0.0, 0.0, 1.0]), tmp_path / "other.map"
    _keep_earth(
        _map_of(
            tmp_path / "moved.map", replace(drive, path=replace(drive.path, T_map_body=moved @ T))
        ),
        file,
    )
    assert main(["georeference", str(run), str(tmp_path / "moved.map")]) == 0
    found = read_trajectory(run / "earth" / "trajectory_enu.tum").T_world_body
    np.testing.assert_allclose(found, np.array(saved["T_enu_map"]) @ moved @ T, atol=1e-4)
    _keep_earth(_map_of(other, replace(drive, path=replace(drive.path, T_map_body=T[::-1]))), file)
    assert "was localised in another map than" in refused(capsys, "georeference", run, other)
    (run / "metrics.json").write_text(json.dumps({**metrics, "map": None}))
    for arguments, message in (
        ([str(run), str(file)], "is no run that found its place in a map"),
        (
            [str(file), str(_map_of(tmp_path / "b.map", drive))],
            "nothing says where it is on the earth",
        ),
    ):
        assert message in refused(capsys, "georeference", *arguments)


def test_places_a_run(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = tmp_path / "run"
    assert main(["run", str(flight), "--out", str(run), "--no-plot", "--json"]) == 0
    before = (run / "trajectory.tum").read_bytes()
    reference = read_trajectory(run / "reference.tum")
    assert reference.times_ns is not None
    T = (
        se3_exp(np.array([5.0, 6.0, 7.0, 0, 0, 2.0]))
        @ se3_inverse(reference.T_world_body[0])
        @ reference.T_world_body
    )
    geodetic = LocalFrame(ORIGIN).geodetic(T[:, :3, 3])
    C = np.tile(0.02**2 * np.eye(3), (len(T), 1, 1))
    gnss = _csv(tmp_path / "gnss.csv", checked_fixes(reference.times_ns, geodetic, C, "x"))
    facts = json_of(capsys, "georeference", run, gnss)
    assert facts["positions_used"] >= 3
    assert np.array(facts["covariance"]).shape == (6, 6)
    saved = json.loads((run / "earth" / "earth.json").read_text())
    assert saved["origin"]["datum"] == "WGS84"
    lon, lat, _ = json.loads((run / "earth" / "trajectory.geojson").read_text())["features"][0][
        "geometry"
    ]["coordinates"][0]
    assert abs(lat - geodetic[0, 0]) < 1e-5
    assert abs(lon - geodetic[0, 1]) < 1e-5
    assert "EPSG:32632" in (run / "earth" / "trajectory_utm.csv").read_text()
    assert (run / "earth" / "landmarks.geojson").is_file()
    assert (run / "trajectory.tum").read_bytes() == before
    for arguments, message in (
        ([str(run), str(tmp_path / "none.csv")], "holds no GNSS positions"),
        ([str(run), str(gnss), "--lever-arm", "1,2"], "--lever-arm takes three numbers"),
        ([str(run), str(gnss), "--time-offset", "1000"], "are within the trajectory"),
        ([str(tmp_path), str(gnss)], "holds the results of runs; give one of them"),
    ):
        assert message in refused(capsys, "georeference", *arguments)
    # the first frame, seen again
    loop = LoopEvent(5, 0, 0, 0, 30, 0.1, joined=False, keyframe_frame=0)
    monkeypatch.setattr(
        "vio.offline.georeference.read_loops", lambda _: [loop, replace(loop, keyframe_frame=None)]
    )
    path = placed(run).path
    assert (path.first.tolist(), path.second.tolist()) == ([0], [5])


def test_landmarks_and_vertical_of_a_run_are_in_its_map(tmp_path: Path) -> None:
    T = np.tile(np.eye(4), (50, 1, 1))
    T[:, 0, 3] = 2.0 * np.arange(50)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [100, 50, 7]
    (tmp_path / "metrics.json").write_text(
        json.dumps({"T_cam0_imu": np.eye(4).tolist(), "motion": "imu"})
    )
    times, frames = np.arange(50) * 10**8, np.arange(50)
    for name, poses in (("trajectory.tum", T), ("map_trajectory.tum", M @ T)):
        write_tum(tmp_path / name, Trajectory(poses, times, "imu", frame_indices=frames))
    point = np.array([1, 3, 0, 0], dtype="<f4")
    (tmp_path / "landmarks.ply").write_bytes(b"ply\nend_header\n" + point.tobytes())
    of = placed(tmp_path)
    np.testing.assert_allclose(of.points, [[101, 50, 10]], atol=1e-6)
    np.testing.assert_allclose(of.path.up_map, M[:3, 2], atol=1e-9)
    g = np.array([0.981, 0.0, -9.76])  # better known than at the start
    np.save(
        tmp_path / "estimates.npy", estimate_row(49, Estimate(0, T[-1], np.eye(6), gravity_world=g))
    )
    np.testing.assert_allclose(
        placed(tmp_path).path.up_map, -M[:3, :3] @ g / np.linalg.norm(g), atol=1e-9
    )


def test_keyframes_say_what_is_up_in_a_map_without_loops(tmp_path: Path) -> None:
    drive, up = _drive(seed=0, poses=300), np.array([0.6, 0.0, 0.8])
    assert placed(_map_of(tmp_path / "a.map", drive)).path.up_map.tolist() == [0, 0, 1]
    np.testing.assert_allclose(
        placed(_map_of(tmp_path / "b.map", drive, up)).path.up_map, up, atol=1e-9
    )


def test_a_drive_that_never_moves_is_refused_in_words() -> None:
    none, n = np.zeros(0, dtype=np.int64), 60
    t = np.arange(n) * 10**9
    path = GraphPath(
        t, np.tile(np.eye(4), (n, 1, 1)), none, none, np.array([0, 0, 1.0]), np.radians(0.3), none
    )
    noise = np.random.default_rng(0).normal(size=(n, 3))
    fixes = checked_fixes(t, LocalFrame(ORIGIN).geodetic(noise), None, "x")
    with pytest.raises(EstimationError, match="do not determine"):
        georeference(path, fixes, np.zeros(3))


def test_what_positions_leave_open_to_rounding_is_refused() -> None:
    """No variance is negative, as for a jump in a map whose x is up: -1e18 m^2."""
    p = np.array([[0.0, 0.0, 0.0], [2.5, 1e6, 0.0], [5.0, 1e6, 0.0]])
    times_ns = np.linspace(0, 1_000_000_000, 30).astype(np.int64)
    enu = np.stack([np.interp(1e-9 * times_ns, [0.0, 0.5, 1.0], p[:, k]) for k in range(3)], 1)
    enu += np.random.default_rng(90).normal(0.0, 0.5, enu.shape)
    geodetic = LocalFrame(np.array([89.9, 179.9999, 50.0])).geodetic(enu)
    geodetic[:, 2] = np.nan
    fixes = checked_fixes(times_ns, geodetic, None, "fixes")
    none = np.zeros(0, dtype=np.int64)
    poses = se3_from_parts(np.tile(np.eye(3), (3, 1, 1)), p)
    times_ns = 500_000_000 * np.arange(3)
    path = GraphPath(times_ns, poses, none, none, np.array([1.0, 0.0, 0.0]), 0.05, none)
    with pytest.raises(EstimationError, match="do not determine"):
        georeference(path, fixes, np.zeros(3))


def test_tables_state_what_is_known(tmp_path: Path) -> None:
    """Horizontal standard deviations without that of the height, and columns between blanks."""
    file = tmp_path / "gnss.csv"
    file.write_text("1,48,11,,0.02,0.02,\n2,48.1,11,,0.02,0.02,\n")
    assert read_gnss(file, None).covariance[0, 0, 0] < 0.001
    file.write_text("1 48 11 500\n2 48.1 11 500\n")
    assert len(read_gnss(file, None).times_ns) == 2


def test_a_fix_beside_a_row_without_one_of_the_same_time_is_kept() -> None:
    times_ns = np.array([1, 1, 2, 2, 2])
    geodetic = np.array([[0, 0, 0], [48, 11, 5], [48.1, 11, 5], [0, 0, 0], [48.2, 11, 5]])
    fixes = checked_fixes(times_ns, geodetic, None, "x")
    assert fixes.times_ns.tolist() == [1, 2]
    assert fixes.geodetic[:, 0].tolist() == [48, 48.1]


def test_a_path_across_the_equator_is_in_one_zone(tmp_path: Path) -> None:
    write_utm(tmp_path / "x.csv", np.array([[1e-4, 11.0, 0.0], [-1e-4, 11.0, 0.0]]))
    northings = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=2)[:, 1]
    assert abs(northings[0] - northings[1]) < 30


def _precise(drive: Drive) -> GnssFixes:
    """Positions of the drive's antenna to 2 cm."""
    before, share, _ = places_between(drive.path, drive.fixes.times_ns)
    p = drive.T_enu[:, :3, 3] + drive.T_enu[:, :3, :3] @ LEVER_M
    p = (1 - share)[:, None] * p[before] + share[:, None] * p[before + 1]
    p += np.random.default_rng(9).normal(0, 0.02, p.shape)
    geodetic = LocalFrame(ORIGIN).geodetic(p)
    return replace(drive.fixes, geodetic=geodetic, covariance=1e-4 * drive.fixes.covariance)


@pytest.mark.parametrize("late_s", [-0.5, 0.0, 0.5])
def test_another_clock_of_a_precise_receiver_is_named(late_s: float) -> None:
    drive = _drive(seed=43)
    fixes = _precise(drive)
    fixes = replace(fixes, times_ns=fixes.times_ns + round(1e9 * late_s))
    said = clock_doubt(drive.path, fixes, LEVER_M, 0)
    if late_s == 0.0:
        assert said is None
    else:
        assert said is not None
        assert f"give --time-offset={-late_s:.2f}" in said
        assert clock_doubt(drive.path, fixes, LEVER_M, round(-1e9 * late_s)) is None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("jumps", [(), ((30, 50, (57.0, 0.0, 0.0)), (60, 80, (25.0, 0.0, 0.0)))])
def test_errors_of_positions_are_no_other_clock(seed: int, jumps: Sequence[Jump]) -> None:
    drive = _drive(seed=seed, jumps=jumps)
    assert clock_doubt(drive.path, drive.fixes, LEVER_M, 0) is None


def test_the_heading_of_a_tilted_map_is_as_uncertain_as_that_of_drawn_ones() -> None:
    """As of images alone, of a rig that was rolled to its side: roll and yaw turn its x axis."""
    rng = np.random.default_rng(5)
    T = se3_exp([0.0, 0.0, 0.0, 0.3, -0.8, 0.5])
    root = 0.004 * rng.normal(size=(6, 6))
    stated = heading_deg(T, root @ root.T)[1]
    drawn = T @ se3_exp(rng.normal(size=(4000, 6)) @ root.T)
    headings = np.degrees(np.arctan2(drawn[:, 1, 0], drawn[:, 0, 0]))
    assert stated == pytest.approx(headings.std(), rel=0.05)
