"""Trajectories as other systems write them: their headers are believed, and what no header states
is tried against the other trajectory.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.errors import DataError, EvaluationError
from vio.evaluation.trajectories import evaluate
from vio.files.pose_matrices import are_matrix_files
from vio.files.text import check_increasing
from vio.files.trajectories import is_trajectory_file, read_trajectory, write_tum
from vio.geometry.lie import (
    FloatArray,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_from_parts,
    so3_exp,
)
from vio.offline.convert_trajectory import convert_trajectory
from vio.records import Trajectory

COUNT = 60
START_NS = 1_700_000_000_000_000_000
TIMES_NS = START_NS + 100_000_000 * np.arange(COUNT)


def _poses() -> FloatArray:
    k = np.arange(COUNT)
    phi = np.stack([0.02 * k, 0.03 * k + 0.4, 0.5 * np.sin(0.1 * k)], axis=1)
    positions = np.stack([0.1 * k, 2 * np.sin(0.1 * k), np.cos(0.07 * k)], axis=1)
    return se3_from_parts(so3_exp(phi), positions)


TRUTH = Trajectory(_poses(), TIMES_NS, "imu")
Q = quat_xyzw_from_rotation(TRUTH.T_world_body[:, :3, :3])
P = TRUTH.positions


def _write(
    path: Path, header: str, stamps: list[str], columns: list[FloatArray], separator: str = " "
) -> Path:
    values = np.column_stack(columns)
    rows = [
        separator.join([t, *map(repr, map(float, row))])
        for t, row in zip(stamps, values, strict=True)
    ]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


SECONDS = [f"{t // 10**9}.{t % 10**9:09d}" for t in TIMES_NS.tolist()]
NS = [str(t) for t in TIMES_NS.tolist()]
XYZW = [P, Q]
WXYZ = [P, Q[:, [3, 0, 1, 2]]]
ZERO = np.zeros((COUNT, 6))
_OKVIS = (
    "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, "
    "v_WS_W_x, v_WS_W_y, v_WS_W_z, b_g_x, b_g_y, b_g_z, b_a_x, b_a_y, b_a_z"
)
STATED = {
    "csv with xyzw": ("#timestamp [ns],x [m],y [m],z [m],qx,qy,qz,qw", NS, XYZW, ","),
    "euroc": ("#timestamp [ns],p_RS_R_x [m],p_y,p_z,q_RS_w [],q_RS_x [],q_y,q_z", NS, WXYZ, ","),
    "okvis2": (_OKVIS, NS, [*XYZW, ZERO, ZERO[:, :3]], ","),
    "tum with w first": ("# timestamp tx ty tz qw qx qy qz", SECONDS, WXYZ, " "),
    "tum in ns": ("# timestamp [ns] tx ty tz qx qy qz qw", NS, XYZW, " "),
    "tum, csv": ("timestamp [s],tx,ty,tz,qx,qy,qz,qw", SECONDS, XYZW, ","),
    "semicolons": ("#timestamp [ns];x;y;z;qx;qy;qz;qw", NS, XYZW, ";"),
    "openvins": (
        "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33",
        SECONDS,
        [*XYZW, ZERO],
        " ",
    ),
    "4seasons": (
        "# frame_id [ns], translation (t_x, t_y, t_z), rotation (q_x, q_y, q_z, w), scale, quality",
        NS,
        [*XYZW, ZERO[:, :2]],
        ",",
    ),
    "glasses": (
        "tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device,"
        "qx_world_device,qy_world_device,qz_world_device,qw_world_device,"
        "device_linear_velocity_x_device,gravity_x_world,quality_score",
        [str(t // 1000) for t in TIMES_NS.tolist()],
        [ZERO[:, 0], *XYZW, ZERO[:, :3]],
        ",",
    ),
    "metres and millimetres in names": (
        "time_ns,frame,x_mm,y_mm,z_mm,q_w,q_x,q_y,q_z",
        NS,
        [ZERO[:, 0], 1000 * P, *WXYZ[1:]],
        ",",
    ),
    "centimetres in brackets": ("# t [ns] x [cm] y [cm] z [cm] qx qy qz qw", NS, [100 * P, Q], " "),
    "east, north, up": ("time_ns,easting,northing,altitude,qx,qy,qz,qw", NS, XYZW, ","),
    "a bare quaternion beside a named position": (
        "timestamp [ns],w,x,y,z,tx,ty,tz",
        NS,
        [WXYZ[1], P],
        ",",
    ),
    "a bare quaternion behind a bare position": (
        "timestamp [ns],x,y,z,x,y,z,w",
        NS,
        XYZW,
        ",",
    ),
    "one word before all": (
        "timestamp [ns],gt_x,gt_y,gt_z,gt_qx,gt_qy,gt_qz,gt_qw",
        NS,
        XYZW,
        ",",
    ),
    "an index and a latency": (
        "timestamp [ns],index,latency,quality,hz,tx,ty,tz,qx,qy,qz,qw",
        NS,
        [ZERO[:, :4] + 9, *XYZW],
        ",",
    ),
    "another vector before": (
        "timestamp [ns],magx,magy,magz,ref_x,ref_y,ref_z,x,y,z,qx,qy,qz,qw",
        NS,
        [ZERO + 50, *XYZW],
        ",",
    ),
    "standard deviations before": (
        "timestamp [ns],p_std_x,p_std_y,p_std_z,p_x,p_y,p_z,qx,qy,qz,qw",
        NS,
        [ZERO[:, :3] + 50, *XYZW],
        ",",
    ),
    "an update and a mask": (
        "timestamp [ns],update,elevation_mask,east_std,east,north,up,qx,qy,qz,qw",
        NS,
        [ZERO[:, :3] + 9, *XYZW],
        ",",
    ),
    "a week's seconds and a source": (
        "time_ns,tow,source,x,y,z,qx,qy,qz,qw",
        NS,
        [ZERO[:, :2], *XYZW],
        ",",
    ),
    "rostopic": (
        "%time [ns],field.header.seq,field.pose.position.x,field.pose.position.y,"
        "field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
        "field.pose.orientation.z,field.pose.orientation.w",
        NS,
        [ZERO[:, 0], *XYZW],
        ",",
    ),
}


@pytest.mark.parametrize("form", STATED)
def test_what_a_header_states_is_believed(form: str, tmp_path: Path) -> None:
    header, stamps, columns, separator = STATED[form]
    file = _write(tmp_path / "poses.txt", header, stamps, columns, separator)
    found = read_trajectory(file)
    assert found.orientations == "stated"
    np.testing.assert_array_equal(found.times_ns, TIMES_NS)
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)


NUMBERED = {
    "flight controller": (
        "timestamp [ns],position[0],position[1],position[2],q[0],q[1],q[2],q[3],velocity[0]",
        [*WXYZ, ZERO[:, 0]],
        "w first, assumed",
    ),
    "from one": ("timestamp [ns],p1,p2,p3,q1,q2,q3,q4", WXYZ, "w first, assumed"),
}


@pytest.mark.parametrize("form", NUMBERED)
def test_components_may_have_numbers(form: str, tmp_path: Path) -> None:
    header, columns, orientations = NUMBERED[form]
    found = read_trajectory(_write(tmp_path / "poses.csv", header, NS, columns, ","))
    assert found.orientations == orientations
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)


ALONE = {
    "angles": ("time_ns,x,y,z,roll,pitch,yaw", [P, ZERO[:, :3]], ","),
    "angles and a state": ("time_ns,x,y,z,roll,pitch,yaw,status", [P, ZERO[:, :4]], ","),
    "angles between white space": ("time_ns x y z roll pitch yaw", [P, ZERO[:, :3]], " "),
    "a heading": ("time_ns,ref_ns,x,y,z,vx,vy,vz,heading", [ZERO[:, 0], P, ZERO[:, :4]], ","),
    "an inertial system": (
        "timestamp [ns],ins_status,latitude,longitude,altitude,easting,northing,up,roll,pitch,yaw",
        [ZERO[:, :4], P, ZERO[:, :3]],
        ",",
    ),
    "an index": ("time_ns,index,x,y,z", [ZERO[:, 0] + 9, P], ","),
    "a latency": ("time_ns,latency,x,y,z", [ZERO[:, 0] + 9, P], ","),
    "a speed": ("time_ns,x,y,z,speed", [P, ZERO[:, 0]], ","),
}


@pytest.mark.parametrize("form", ALONE)
def test_positions_beside_angles_are_read_alone(form: str, tmp_path: Path) -> None:
    header, columns, separator = ALONE[form]
    found = read_trajectory(_write(tmp_path / "poses.csv", header, NS, columns, separator))
    assert found.orientations == "none"
    np.testing.assert_array_equal(found.times_ns, TIMES_NS)
    np.testing.assert_allclose(found.positions, P, atol=1e-12)


def test_north_east_and_down_are_right_handed(tmp_path: Path) -> None:
    header = "time_ns,easting,northing,down,roll"
    file = _write(tmp_path / "poses.csv", header, NS, [P, ZERO[:, 0]], ",")
    np.testing.assert_allclose(read_trajectory(file).positions, P[:, [1, 0, 2]], atol=1e-12)


REFUSED = {
    "two times a row": (
        "source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw\n2,1,0,0,0,0,0,0\n",
        "names two times a row, as of motions from one to the other",
    ),
    "two units": (
        "t,x_mm,y_mm,z_cm,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n",
        "several units of the position",
    ),
    "feet": ("t,x_ft,y_ft,z_ft,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n", "states positions in 'ft'"),
    "inches": ("t,x [in],y [in],z [in]\n1,0,0,0\n", "states positions in 'in'"),
    "micrometres": ("# t x [µm] y [µm] z [µm]\n1 0 0 0\n", "states positions in 'um'"),
    "a unit and no quaternion": (
        "t,x [mm],y [mm],z [mm],a,b,c,d\n1,0,0,0,0,0,0,1\n",
        "names no quaternion behind it; name its columns",
    ),
    "standard deviations and one letter": (
        "t,east_std,north_std,up_std,E,N,U,qx,qy,qz,qw\n1,0,0,0,1,2,3,0,0,0,1\n",
        "the quaternion has norm",
    ),
    "COLMAP": (
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 0 0 0 1 0.png\n",
        "is a model of COLMAP, whose poses map the world to each camera",
    ),
    "JSON": ('{"frames": []}\n', "is JSON; write a table of 8 columns"),
    "Motive": (
        "Format Version,1.23,Take Name,a\n,,Rigid Body\n",
        "is an export of Motive or Vicon",
    ),
    "an IMU": (
        "time,wx,wy,wz,ax,ay,az,temp\n1,0,0,0,9,1,2,3\n",
        r"its header \(time, wx, wy, wz, …\) names no pose: give a table of poses",
    ),
    "no norm": ("1 2 3 0 0 1 1\n", "a quaternion without a time has the norm 1"),
    "angles without a header": ("1,2,3,4,5,6,7\n", "give the first four columns alone"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_are_no_poses_is_refused_by_what_it_is(case: str, tmp_path: Path) -> None:
    text, message = REFUSED[case]
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("data", "kind"),
    [(b"\x93NUMPY\x01\x00", "an array of NumPy"), (b"PK\x03\x04\xff", "a ZIP archive")],
)
def test_binary_files_of_poses_are_named(data: bytes, kind: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_bytes(data)
    with pytest.raises(DataError, match=f"it is {kind}.*: write it as text"):
        read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    "names",
    ["#sec,nsec", "sec,nanosec", "header.stamp.secs,header.stamp.nsecs", "Seconds,Nanoseconds"],
)
def test_seconds_and_nanoseconds_in_two_columns(names: str, tmp_path: Path) -> None:
    whole = [str(t // 10**9) for t in TIMES_NS.tolist()]
    rows = [
        ",".join([s, str(t % 10**9), *map(repr, map(float, [*p, *q]))])
        for s, t, p, q in zip(whole, TIMES_NS.tolist(), P, Q, strict=True)
    ]
    (tmp_path / "poses.csv").write_text(f"{names},x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n")
    found = read_trajectory(tmp_path / "poses.csv")
    np.testing.assert_array_equal(found.times_ns, TIMES_NS)
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)


def test_orb_slam3_writes_nanoseconds_with_a_point(tmp_path: Path) -> None:
    file = _write(tmp_path / "kf.txt", "", [f"{t}.000000" for t in NS], XYZW)
    np.testing.assert_array_equal(read_trajectory(file).times_ns, TIMES_NS)


def test_rows_that_end_with_a_comma(tmp_path: Path) -> None:
    """VINS-Fusion writes a comma behind each number, and no header."""
    file = _write(tmp_path / "vio.csv", "", NS, [*WXYZ, ZERO[:, :3]], ",")
    file.write_text(file.read_text().replace("\n", ",\n"))
    assert is_trajectory_file(file)
    found = read_trajectory(file)
    assert found.orientations == "w first, assumed"
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)


UNSTATED = {
    "csv with w last": (NS, XYZW, ",", "first"),
    "tum with w first": (SECONDS, WXYZ, " ", "last"),
}


@pytest.mark.parametrize("form", UNSTATED)
@pytest.mark.parametrize("which", ["estimate", "reference"])
def test_the_other_trajectory_tells_an_order_that_is_not_stated(
    form: str, which: str, tmp_path: Path
) -> None:
    stamps, columns, separator, read = UNSTATED[form]
    found = read_trajectory(_write(tmp_path / "poses.txt", "", stamps, columns, separator))
    assert found.orientations == f"w {read}, assumed"
    pair = (found, TRUTH) if which == "estimate" else (TRUTH, found)
    result = evaluate(*pair)
    assert result.ate_deg.rmse < 1e-6
    (note,) = result.notes
    assert f"the {which} does not state the order of its quaternions" in note
    assert f"w {read} would leave" in note


@pytest.mark.parametrize("which", ["estimate", "reference"])
@pytest.mark.parametrize("turn_rad", [0.0, 0.5])
def test_where_neither_states_its_order_the_better_explanation_counts(
    which: str, turn_rad: float, tmp_path: Path
) -> None:
    """Either file read in its other order explains these attitudes: in one world to rounding, in
    two one of them far better.
    """
    phi = 0.3 * np.stack([np.sin(k := 0.1 * np.arange(COUNT)), np.cos(0.7 * k), np.sin(1.3 * k)], 1)
    base = rotation_from_quat_xyzw(np.array([-0.6855, -0.2409, -0.6501, 0.2223]))
    truth = replace(TRUTH, T_world_body=se3_from_parts(base @ so3_exp(phi), P))
    Q_true = quat_xyzw_from_rotation(truth.T_world_body[:, :3, :3])
    tum = read_trajectory(_write(tmp_path / "e.tum", "", SECONDS, [P, Q_true]))
    T_other = se3_from_parts(so3_exp(np.array([turn_rad, 0.0, -turn_rad])), np.zeros(3))
    other = T_other @ truth.T_world_body
    columns = [other[:, :3, 3], quat_xyzw_from_rotation(other[:, :3, :3])]
    csv = read_trajectory(_write(tmp_path / "r.csv", "", NS, columns, ","))
    assert (tum.orientations, csv.orientations) == ("w last, assumed", "w first, assumed")
    result = evaluate(csv, tum) if which == "estimate" else evaluate(tum, csv)
    assert result.ate_deg.rmse < 1e-6
    (note,) = result.notes
    assert f"the {which} does not state the order of its quaternions" in note


def test_a_stated_order_is_not_exchanged_and_the_wrong_one_is_blamed(tmp_path: Path) -> None:
    wrong = _write(tmp_path / "e.txt", "# timestamp tx ty tz qx qy qz qw", SECONDS, WXYZ)
    estimate = read_trajectory(wrong)
    assert estimate.orientations == "stated"
    (note,) = evaluate(estimate, TRUTH).notes
    assert (
        "the estimate's orientations are quaternions with w first, read as if w came last" in note
    )


def test_a_right_order_that_is_assumed_stays(tmp_path: Path) -> None:
    found = read_trajectory(_write(tmp_path / "poses.txt", "", NS, WXYZ, ","))
    result = evaluate(found, TRUTH)
    assert (result.notes, result.ate_deg.rmse < 1e-6) == ((), True)


POSITIONS = {
    "zeros": [P, np.zeros((COUNT, 4))],
    "nan": [P, np.full((COUNT, 4), np.nan)],
    "four columns": [P],
}


@pytest.mark.parametrize("form", POSITIONS)
@pytest.mark.parametrize("separator", [" ", ","])
def test_positions_without_orientations_are_compared_alone(
    form: str, separator: str, tmp_path: Path
) -> None:
    header = "# timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]" * (form[0] == "f")
    columns = POSITIONS[form]
    truth = read_trajectory(_write(tmp_path / "truth.txt", header, NS, columns, separator))
    assert truth.orientations == "none"
    np.testing.assert_allclose(truth.positions, P)
    result = evaluate(TRUTH, truth)
    assert result.ate_m.rmse < 1e-9
    assert "the reference has positions without orientations" in result.notes[0]
    np.testing.assert_array_equal(truth.in_cam0(TRUTH.T_world_body[5]).positions, truth.positions)


def test_single_poses_without_orientation_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    q = Q.copy()
    q[5:8] = 0
    found = read_trajectory(_write(tmp_path / "truth.txt", "", SECONDS, [P, q]))
    assert len(found) == COUNT - 3
    assert "3 of 60 poses have no orientation" in caplog.text


def test_what_is_written_states_its_order(tmp_path: Path) -> None:
    write_tum(tmp_path / "out.tum", TRUTH)
    assert read_trajectory(tmp_path / "out.tum").orientations == "stated"


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_between_semicolons_or_tabs_are_read(separator: str, tmp_path: Path) -> None:
    rows = [
        [1700000000000000000 + 50_000_000 * k, 0.5 * k, 1.25, -2.0, 0.5, 0.5, -0.5, 0.5]
        for k in range(5)
    ]
    names = ["timestamp_ns", "x", "y", "z", "qw", "qx", "qy", "qz"]
    plain = tmp_path / "plain.csv"
    plain.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n")
    lines = [separator.join(map(str, row)).replace(".", ",") for row in rows]
    local = tmp_path / "local.csv"
    local.write_text("\n".join([separator.join(names), *lines]) + "\n")
    expected = read_trajectory(plain)
    read = read_trajectory(local)
    np.testing.assert_array_equal(read.T_world_body, expected.T_world_body)
    assert read.times_ns.tolist() == expected.times_ns.tolist()


@pytest.mark.parametrize("first", ["r11 r12 r13 tx", "R00 R01 R02 x"])
def test_a_header_may_name_the_elements_of_matrices(first: str, tmp_path: Path) -> None:
    rows = " ".join([first, first.replace("x", "y"), first.replace("x", "z")])
    poses = TRUTH.T_world_body[:, :3].reshape(COUNT, 12)
    text = "\n".join(" ".join(map(repr, row)) for row in poses.tolist())
    (tmp_path / "poses.txt").write_text(f"# {rows}\n{text}\n")
    found = read_trajectory(tmp_path / "poses.txt")
    assert found.times_ns is None
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)
    led = "\n".join(f"{t} {row}" for t, row in zip(SECONDS, text.split("\n"), strict=True))
    (tmp_path / "poses.txt").write_text(f"# time {rows}\n{led}\n")
    found = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_array_equal(found.times_ns, TIMES_NS)
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)


def test_units_of_positions_that_are_applied_or_unknown_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    header = "t [ns],x_cm,y_cm,z_cm"
    read_trajectory(_write(tmp_path / "a.csv", header, NS, [100 * P], ","))
    assert "x_cm, y_cm, z_cm are converted to metres, by 0.01" in caplog.text
    header = "t [ns],x [vu],y [vu],z [vu]"
    found = read_trajectory(_write(tmp_path / "b.csv", header, NS, [P], ","))
    np.testing.assert_allclose(found.positions, P, atol=1e-12)
    assert "doubtful: the unit 'vu' of x [vu], y [vu], z [vu] is not known" in caplog.text


def test_whole_matrices_are_read(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.5, 2.5]
    file = tmp_path / "poses.txt"
    np.savetxt(file, poses.reshape(3, 16))
    found = read_trajectory(file)
    np.testing.assert_array_equal(found.T_world_body, poses)
    assert found.body == "cam0"
    poses[1, 3, 3] = 2.0
    np.savetxt(file, poses.reshape(3, 16))
    with pytest.raises(DataError, match="line 2: the last of 16 columns are not 0 0 0 1"):
        read_trajectory(file)


@pytest.mark.parametrize(("rows", "body"), [(3, "imu"), (4, "cam0")])
def test_matrices_may_have_a_number_or_a_time_in_front(
    rows: int, body: str, tmp_path: Path
) -> None:
    matrices = TRUTH.T_world_body[:, :rows].reshape(COUNT, -1)
    numbers = [str(2 * k + 1) for k in range(COUNT)]
    found = read_trajectory(_write(tmp_path / "poses.txt", "", numbers, [matrices]))
    assert found.times_ns is None
    assert found.body == body
    np.testing.assert_array_equal(found.frame_indices, 2 * np.arange(COUNT) + 1)
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-12)
    timed = read_trajectory(_write(tmp_path / "timed.txt", "", SECONDS, [matrices]))
    np.testing.assert_array_equal(timed.times_ns, TIMES_NS)
    numbers[7] = "3"
    with pytest.raises(DataError, match="line 8: the numbers of frames do not increase"):
        read_trajectory(_write(tmp_path / "poses.txt", "", numbers, [matrices]))


@pytest.mark.parametrize(
    "line", ["VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", "VERTEX3 1 0 0 0 0 0 0", "EDGE_SE3:QUAT 1 2 0 0 0"]
)
def test_a_graph_has_no_times(line: str, tmp_path: Path) -> None:
    file = tmp_path / "graph.g2o"
    file.write_text(line + "\n")
    with pytest.raises(DataError, match=r"a graph of poses .* which have no times"):
        read_trajectory(file)


def test_poses_without_times_are_told_so_before_an_extrinsic_is_asked_for(tmp_path: Path) -> None:
    matrices = TRUTH.T_world_body[::2, :3].reshape(COUNT // 2, 12)
    np.savetxt(tmp_path / "poses.txt", matrices)
    with pytest.raises(EvaluationError, match="30 poses without times"):
        evaluate(read_trajectory(tmp_path / "poses.txt"), TRUTH)


@pytest.mark.parametrize(
    ("names", "first", "second"),
    [
        ("time_sec,exposure_nsec", lambda t: f"{t // 10**9}.{t % 10**9:09d}", lambda t: 5_000_000),
        ("time_sec,time_nsec", lambda t: f"{t // 10**9}.{t % 10**9:09d}", lambda t: t),
        ("time_usec,time_nsec", lambda t: t // 1000, lambda t: t % 1000),
    ],
)
def test_nanoseconds_beside_whole_times_are_no_rest(
    names: str, first: Callable[[int], object], second: Callable[[int], object], tmp_path: Path
) -> None:
    rows = [
        ",".join(map(str, (first(t), second(t), *p, *q)))
        for t, p, q in zip(TIMES_NS.tolist(), P.tolist(), Q.tolist(), strict=True)
    ]
    (tmp_path / "poses.csv").write_text(f"{names},x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n")
    found = read_trajectory(tmp_path / "poses.csv")
    assert found.times_ns is not None
    assert np.abs(found.times_ns - TIMES_NS).max() < 1000


def test_poses_that_a_camera_system_lost_and_rows_written_twice_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = _write(tmp_path / "truth.txt", "", SECONDS, XYZW)
    rows = file.read_text().splitlines()
    rows[3] = SECONDS[3] + 7 * " nan"
    rows.insert(10, rows[10])
    file.write_text("\n".join(rows) + "\n")
    found = read_trajectory(file)
    kept = np.arange(COUNT) != 3
    np.testing.assert_array_equal(found.times_ns, TIMES_NS[kept])
    np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body[kept], atol=1e-12)
    assert any("1 poses are not numbers and are left out" in line for line in caplog.messages)
    assert any("1 rows repeat the one above" in line for line in caplog.messages)
    lost = [stamp + 7 * " nan" for stamp in SECONDS[: COUNT // 2]]
    file.write_text("\n".join([*lost, *rows[-10:]]) + "\n")
    with pytest.raises(DataError, match="line 1: a pose is not finite"):
        read_trajectory(file)
    rows[3] = f"{SECONDS[3]} nan 0 0 0 0 0 1"
    file.write_text("\n".join(rows) + "\n")
    with pytest.raises(DataError, match="line 4: a pose is not finite"):
        read_trajectory(file)


@pytest.mark.parametrize(
    ("shift", "words"),
    [
        (0, "it was written twice; keep one of both parts"),
        (-7, "as of two recordings in one file"),
        (7, "remove or reorder that entry"),  # a step back
    ],
)
def test_times_that_begin_again_are_named(shift: int, words: str) -> None:
    once = 10**9 * np.arange(1, 21)
    times = np.concatenate([once, once + shift * 10**8])
    with pytest.raises(DataError, match=rf"entry 20: the clock runs backwards .*{words}"):
        check_increasing(times, lambda k: f"entry {k}")


@pytest.mark.parametrize(
    ("unit_ns", "unit"), [(1, "nanoseconds"), (10**3, "microseconds"), (10**6, "milliseconds")]
)
def test_a_counter_of_32_bits_that_begins_again_is_named(unit_ns: int, unit: str) -> None:
    counted = (2**32 - 20_000 + 5_000 * np.arange(8)) % 2**32
    with pytest.raises(DataError, match=f"begins again there: add 2.32 {unit} to it"):
        check_increasing(unit_ns * counted, lambda k: f"line {k}")
    with pytest.raises(DataError, match="remove or reorder that entry"):
        check_increasing(unit_ns * (counted * 97 // 100), lambda k: f"line {k}")


@pytest.mark.parametrize("header", ["", "#timestamp [ns],x,y,z,qw,qx,qy,qz"])
def test_an_order_that_is_assumed_is_named_where_poses_are_converted(
    header: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = _write(tmp_path / "poses.csv", header, NS, WXYZ, ",")
    written = convert_trajectory(file, tmp_path / "poses.tum", "tum")
    np.testing.assert_allclose(written.T_world_body, TRUTH.T_world_body, atol=1e-12)
    assert ("does not state the order of its quaternions" in caplog.text) is (header == "")


# --- stamps in two columns, as dates, or in names of images


def _split(separator: str, names: tuple[str, ...] = ()) -> list[str]:
    return [separator.join((str(t // 10**9), str(t % 10**9), *names)) for t in TIMES_NS.tolist()]


@pytest.mark.parametrize("names", [("map",), ("odom", "base_link"), ("",)])
def test_poses_as_ros2_topic_echo_writes_them_are_read(
    names: tuple[str, ...], tmp_path: Path
) -> None:
    covariance = np.zeros((COUNT, 36))
    for columns in (XYZW, [*XYZW, covariance]):
        file = _write(tmp_path / "odom.csv", "", _split(",", names), columns, ",")
        read = read_trajectory(file)
        np.testing.assert_array_equal(read.times_ns, TIMES_NS)
        np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)
        assert read.orientations == "stated"


def test_points_as_ros2_topic_echo_writes_them_are_positions(tmp_path: Path) -> None:
    read = read_trajectory(_write(tmp_path / "p.csv", "", _split(",", ("map",)), [P], ","))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_array_equal(read.positions, P)
    assert read.orientations == "none"


@pytest.mark.parametrize(("separator", "columns"), [(" ", XYZW), (",", WXYZ)])
def test_seconds_and_nanoseconds_without_a_header_are_one_time(
    separator: str, columns: list[FloatArray], tmp_path: Path
) -> None:
    read = read_trajectory(_write(tmp_path / "p", "", _split(separator), columns, separator))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)


def test_two_whole_numbers_that_are_no_clock_are_not_joined(tmp_path: Path) -> None:
    back = [text.replace("1700000003 ", "1700000001 ") for text in _split(" ")]
    small = [f"{k} {k % 7}" for k in range(COUNT)]
    for stamps in (back, small):
        with pytest.raises(DataError, match="9 columns fit no known format"):
            read_trajectory(_write(tmp_path / "p", "", stamps, XYZW))


@pytest.mark.parametrize(
    ("form", "separator", "header"),
    [
        ("{}T{}Z", " ", ""),
        ("{} {}", " ", ""),
        ("{} {}", ",", "time,x,y,z,qx,qy,qz,qw"),
        ("{}T{}", ",", ""),
    ],
)
def test_dates_of_poses_are_read(form: str, separator: str, header: str, tmp_path: Path) -> None:
    dates = [str(np.datetime64(t, "ns")).split("T") for t in TIMES_NS.tolist()]
    stamps = [form.format(*date) for date in dates]
    columns = XYZW if header or separator == " " else WXYZ
    file = _write(tmp_path / "poses.txt", header, stamps, columns, separator)
    read = read_trajectory(file)
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)
    assert is_trajectory_file(file)
    file.write_text(file.read_text().replace("2023-11-14", "2023-13-14"))
    with pytest.raises(DataError):
        read_trajectory(file)


@pytest.mark.parametrize("columns", [13, 17])
def test_matrices_between_commas_are_read(columns: int, tmp_path: Path) -> None:
    rows = TRUTH.T_world_body[:, : 3 if columns == 13 else 4].reshape(COUNT, -1)
    read = read_trajectory(_write(tmp_path / "global_pose.csv", "", NS, [rows], ","))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)


def test_truth_of_euroc_without_its_header_is_no_matrix(tmp_path: Path) -> None:
    others = np.zeros((COUNT, 9))
    read = read_trajectory(_write(tmp_path / "data.csv", "", NS, [*WXYZ, others], ","))
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)


ANGLES = np.tile([10.0, 20.0, 30.0], (COUNT, 1))
PHOTOGRAMMETRY = [
    ("#PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33", "\t",
     [P, ANGLES, TRUTH.T_world_body[:, :3, :3].reshape(COUNT, 9)]),
    ("#Label,X/East,Y/North,Z/Altitude,Yaw,Pitch,Roll,Error_(m)", ",", [P, ANGLES, ANGLES[:, :1]]),
    ("#name,x,y,alt,heading,pitch,roll", ",", [P, ANGLES]),
]  # fmt: skip


@pytest.mark.parametrize(("header", "separator", "columns"), PHOTOGRAMMETRY)
def test_positions_of_photogrammetry_have_the_times_of_their_images(
    header: str, separator: str, columns: list[FloatArray], tmp_path: Path
) -> None:
    names = [f"{t}.png" for t in NS]
    read = read_trajectory(_write(tmp_path / "cameras.txt", header, names, columns, separator))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_array_equal(read.positions, P)
    assert read.orientations == "none"
    for name in ("IMG_{:04d}.JPG", "{:06d}.png", "20240512_14{:04d}.jpg", "2024051214{:04d}.jpg"):
        names = [name.format(k) for k in range(COUNT)]
        file = _write(tmp_path / "cameras.txt", header, names, columns, separator)
        with pytest.raises(DataError, match=r"names of images .* which are no times"):
            read_trajectory(file)


def test_degrees_beside_the_letter_of_an_axis_are_no_metres(tmp_path: Path) -> None:
    header = "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll"
    file = _write(tmp_path / "reference.csv", header, [f"{t}.png" for t in NS], [P, ANGLES], ",")
    with pytest.raises(DataError, match="names latitude and longitude"):
        read_trajectory(file)


@pytest.mark.parametrize("name", ["frame", "Index", "image_id"])
def test_numbers_of_frames_are_no_times(name: str, tmp_path: Path) -> None:
    header = f"{name},x,y,z,qx,qy,qz,qw"
    numbers = [str(k + 1) for k in range(COUNT)]
    with pytest.raises(DataError, match=f"its column '{name}' numbers frames"):
        read_trajectory(_write(tmp_path / "blender.csv", header, numbers, XYZW, ","))
    read = read_trajectory(_write(tmp_path / "blender.csv", header, SECONDS, XYZW, ","))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)


@pytest.mark.parametrize("name", ["cam0/data/{ns}.png", "{s:.9f}.png", "{day}_%H-%M-%S-%f.png"])
def test_images_are_named_by_times_in_several_ways(name: str, tmp_path: Path) -> None:
    start_ns = 1_700_000_000_000_000_000
    times_ns = start_ns + 50_000_000 * np.arange(COUNT)
    names = []
    for time_ns in times_ns.tolist():
        date = dt.datetime.fromtimestamp(0, dt.timezone.utc) + dt.timedelta(
            microseconds=time_ns // 1000
        )
        text = name.format(ns=time_ns, s=(time_ns - start_ns) * 1e-9, day="%Y-%m-%d")
        names.append(date.strftime(text))
    if ".9f" in name:
        times_ns = times_ns - start_ns
    read = read_trajectory(_write(tmp_path / "a.txt", "#name,x,y,z", names, [P], ","))
    np.testing.assert_array_equal(read.times_ns, times_ns)


@pytest.mark.parametrize("name", ["frame", "image"])
def test_times_under_the_name_of_a_frame_are_times(name: str, tmp_path: Path) -> None:
    read = read_trajectory(_write(tmp_path / "a.csv", f"{name},x,y,z,qx,qy,qz,qw", NS, XYZW, ","))
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    # a comment that names no columns
    seconds = [str(1_700_000_000 + k) for k in range(COUNT)]
    read = read_trajectory(_write(tmp_path / "a.txt", "# frame map", seconds, XYZW, " "))
    assert read.times_ns is not None
    assert set(np.diff(read.times_ns)) == {10**9}


def test_poses_without_times_are_those_of_frames(tmp_path: Path) -> None:
    back = slice(None, None, -1)  # x falls, as no time does
    x = [repr(float(p)) for p in P[back, 0]]
    forms = {
        "a.csv": ("x,y,z,qx,qy,qz,qw", XYZW[1:], ","),
        "pose_left.txt": ("", XYZW[1:], " "),
        "b.csv": ("", WXYZ[1:], ","),
    }
    for name, (header, columns, separator) in forms.items():
        values = [P[back, 1:], *(c[back] for c in columns)]
        read = read_trajectory(_write(tmp_path / name, header, x, values, separator))
        assert (read.times_ns, read.frame_indices, read.body) == (None, None, "cam0")
        np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body[back], atol=1e-12)


def test_the_state_of_openvins_is_read(tmp_path: Path) -> None:
    header = (
        "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans ... "
        "imu_model dw da tg wtoI atoI etc"
    )
    state = np.zeros((COUNT, 35))
    file = _write(tmp_path / "state_estimate.txt", header, SECONDS, [Q, P, ZERO[:, :3], state])
    read = read_trajectory(file)
    np.testing.assert_array_equal(read.times_ns, TIMES_NS)
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)
    assert (read.body, read.orientations) == ("imu", "stated")


def test_standard_deviations_of_openvins_are_no_poses(tmp_path: Path) -> None:
    header = (
        "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans .... etc"
    )
    file = _write(tmp_path / "deviation.txt", header, SECONDS, [np.full((COUNT, 30), 0.01)])
    with pytest.raises(DataError, match=r"the quaternion has norm 0\.02, not 1"):
        read_trajectory(file)


def _matrix_text(T: FloatArray) -> str:
    return "".join(" ".join(map(repr, row)) + "\n" for row in T.tolist())


@pytest.mark.parametrize("above", ["", "{k} {k} {k}\n"])
def test_matrices_may_go_over_four_lines(above: str, tmp_path: Path) -> None:
    text = "".join(above.format(k=k) + _matrix_text(T) for k, T in enumerate(TRUTH.T_world_body))
    (tmp_path / "poses.log").write_text(text)
    read = read_trajectory(tmp_path / "poses.log")
    assert (read.times_ns, read.body) == (None, "cam0")
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body, atol=1e-12)


@pytest.mark.parametrize("name", ["{}.txt", "frame-{:06d}.pose.txt", "{:04d}_pose.csv"])
def test_matrices_may_be_in_a_file_each(name: str, tmp_path: Path) -> None:
    for k, T in enumerate(TRUTH.T_world_body):
        lost = k == 7  # as ScanNet writes it
        (tmp_path / name.format(k)).write_text(
            _matrix_text(np.full((4, 4), -np.inf) if lost else T)
        )
    read = read_trajectory(tmp_path)
    kept = np.delete(np.arange(COUNT), 7)
    np.testing.assert_array_equal(read.frame_indices, kept)
    np.testing.assert_allclose(read.T_world_body, TRUTH.T_world_body[kept], atol=1e-12)


def test_files_of_single_matrices_may_be_named_by_times(tmp_path: Path) -> None:
    for t, T in zip(NS, TRUTH.T_world_body, strict=True):
        (tmp_path / f"{t}.txt").write_text(_matrix_text(T))
    np.testing.assert_array_equal(read_trajectory(tmp_path).times_ns, TIMES_NS)


@pytest.mark.parametrize("name", ["{:06d}_cam0.txt", "cam0.{:06d}.txt", "pose_{:04d}_of_12.txt"])
def test_other_numbers_in_the_names_of_files_are_not_those_of_frames(
    name: str, tmp_path: Path
) -> None:
    for k, T in enumerate(TRUTH.T_world_body):
        (tmp_path / name.format(k)).write_text(_matrix_text(T))
    read = read_trajectory(tmp_path)
    assert read.times_ns is None
    np.testing.assert_array_equal(read.frame_indices, np.arange(COUNT))


@pytest.mark.parametrize("names", [["T_cam0_imu.txt"], ["T_cam0_imu.txt", "P_cam0.txt"]])
def test_matrices_of_a_rig_are_no_trajectory(names: list[str], tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).write_text(_matrix_text(np.eye(4)))
    assert not are_matrix_files(tmp_path)
    with pytest.raises(DataError, match="is a folder"):
        read_trajectory(tmp_path)


@pytest.mark.parametrize("separator", [" ", ","])
@pytest.mark.parametrize("first_s", [0.0, 1.5e9])
def test_a_time_before_six_numbers_is_no_coordinate(
    first_s: float, separator: str, tmp_path: Path
) -> None:
    """A height of one metre beside small angles, or a plane position, has the norm 1, too."""
    k = np.arange(COUNT)
    clock = first_s + 0.1 * k + 0.1 * (k > 9)  # a frame is lost
    hovering = np.column_stack([clock, 0.1 * k, 0 * k, 0 * k + 1, 0.01 * np.sin(k), 0 * k, 0 * k])
    level = np.column_stack([clock, k, -k, 0 * k, 0 * k, np.sin(k), np.cos(k)])
    for rows in (hovering, level):
        text = "\n".join(separator.join(map(repr, row)) for row in rows.tolist())
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(DataError, match=r"or begin with the time, .* name them in a header"):
            read_trajectory(tmp_path / "a.txt")


def test_a_header_says_that_there_is_no_time(tmp_path: Path) -> None:
    x = [repr(0.5 * k) for k in range(COUNT)]
    file = _write(tmp_path / "a.txt", "# tx ty tz qx qy qz qw", x, [P[:, 1:], *XYZW[1:]])
    read = read_trajectory(file)
    assert read.times_ns is None
    np.testing.assert_allclose(read.positions[:, 0], 0.5 * np.arange(COUNT))


def test_files_that_are_no_single_matrix_are_named(tmp_path: Path) -> None:
    (tmp_path / "1.txt").write_text(_matrix_text(np.eye(4)))
    (tmp_path / "0.txt").write_text("1 2 3\n")
    with pytest.raises(DataError, match=r"0.txt: holds 3 numbers, not the 16"):
        read_trajectory(tmp_path)
    (tmp_path / "0.txt").write_text("car 1 2 3\n")
    with pytest.raises(DataError, match=r"0.txt: could not convert .*'car'"):
        read_trajectory(tmp_path)


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_dates_keep_what_is_behind_a_decimal_comma(separator: str, tmp_path: Path) -> None:
    dates = [f"2024-05-12 14:03:{k // 4:02d},{k % 4 * 250:03d}" for k in range(COUNT)]
    file = _write(tmp_path / "a.csv", "", dates, XYZW, separator)
    for points in (True, False):
        if not points:
            file.write_text(file.read_text().replace(".", ","))
        times_ns = read_trajectory(file).times_ns
        assert times_ns is not None
        assert set(np.diff(times_ns)) == {250_000_000}


def test_dates_between_quotes_are_read(tmp_path: Path) -> None:
    dates = [f'"2024-05-12 14:03:{k:02d}.25"' for k in range(COUNT)]
    read = read_trajectory(_write(tmp_path / "a.csv", "", dates, WXYZ, ","))
    assert read.times_ns is not None
    assert read.times_ns[0] % 10**9 == 250_000_000
    file = _write(tmp_path / "a.csv", "", [date[:-1] for date in dates], WXYZ, ",")
    with pytest.raises(DataError, match="is no time"):
        read_trajectory(file)


def test_x_that_points_north_is_no_east(tmp_path: Path) -> None:
    names = [f"{t}.png" for t in NS]
    header = "#Label,X/Northing,Y/Easting,Z/Altitude,Yaw,Pitch,Roll"
    read = read_trajectory(_write(tmp_path / "a.csv", header, names, [P, ANGLES], ","))
    np.testing.assert_array_equal(read.positions, P[:, [1, 0, 2]])


@pytest.mark.parametrize("numbers", [37, 42, 6])
def test_messages_of_other_types_are_no_poses(numbers: int, tmp_path: Path) -> None:
    values = np.zeros((COUNT, numbers))
    values[:, 3] = 1.0  # as the w of an orientation, or of a rate, behind three zeros
    stamps = [f"17000000{k:02d},{500_000_000},imu" for k in range(COUNT)]
    with pytest.raises(DataError, match=f"whose {numbers} numbers are those of no pose"):
        read_trajectory(_write(tmp_path / "a.csv", "", stamps, [values], ","))
