"""A run or a map on the earth, by GNSS positions of its drive."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vio.datasets.gnss_fixes import GnssFixes
from vio.earth.alignment import Georeference, Path, georeference, heading_deg
from vio.earth.clock import clock_doubt
from vio.earth.exports import write_geojson, write_kml, write_points_geojson, write_utm
from vio.earth.geodesy import LocalFrame
from vio.errors import DataError
from vio.files.trajectories import write_tum
from vio.geometry.lie import FloatArray, se3_inverse, se3_log
from vio.geometry.upright import mean_up, up_in
from vio.mapping.map_store import EarthRow, KeyframeRow, LoopRow, MapStore
from vio.records import BoolArray, Trajectory
from vio.runs.finished import point_positions, up_of_odometry
from vio.runs.mapped import read_keyframes, read_loops, read_trajectories
from vio.runs.stated import read_metrics

logger = logging.getLogger(__name__)

FACTS = "earth.json"
_UP_RAD = float(np.radians(0.3))  # of an IMU's vertical; of an upright camera's
_MOUNT_RAD = float(np.radians(5.0))


class _CommonRules(NamedTuple):
    """When run and map have keyframes in common."""

    min_keyframes: int = 3  # keyframes that run and map share
    # by which a motion between two of them may differ, m and rad, and share of it
    same_motion: float = 0.05
    same_share: float = 0.1


_COMMON = _CommonRules()


@dataclass(frozen=True, slots=True)
class Placed:
    """A finished trajectory, ready to be placed on the earth."""

    name: str
    path: Path
    trajectory: Trajectory  # the same poses
    points: FloatArray  # (M, 3) landmarks in its frame


def placed(source: FilePath) -> Placed:
    """Read the trajectory of a run's folder, or the keyframes of a map.

    Raises:
        DataError: it is neither, or states no times.
    """
    return _of_run(source) if source.is_dir() else _of_map(source)


def _of_run(folder: FilePath) -> Placed:
    metrics, T_cam0_imu = read_metrics(folder)
    trajectory, odometry = read_trajectories(folder)
    if trajectory.times_ns is None or len(trajectory) < 2:
        raise DataError(
            f"{folder}: its trajectory has no times, which GNSS positions are compared by"
        )
    # The landmarks and the vertical are those of the odometry's world.
    up = up_of_odometry(folder, metrics)
    if up is not None:
        up = up_in(trajectory.T_world_body, odometry.T_world_body, up)
    camera = trajectory.in_cam0(T_cam0_imu).T_world_body
    path = _path(
        trajectory,
        _loops_of_run(folder, trajectory),
        -camera[0, :3, 1] if up is None else up,
        _MOUNT_RAD if up is None else _UP_RAD,
    )
    p = point_positions(folder)
    _, nearest = cKDTree(odometry.T_world_body[:, :3, 3]).query(p)
    T = (trajectory.T_world_body @ se3_inverse(odometry.T_world_body))[nearest]
    p = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
    return Placed(folder.resolve().name, path, trajectory, p)


def _loops_of_run(folder: FilePath, trajectory: Trajectory) -> list[tuple[int, int]]:
    """Return the loops that a run kept, between poses of its trajectory that do not follow each
    other.
    """
    if trajectory.frame_indices is None:
        return []
    place = {int(f): k for k, f in enumerate(trajectory.frame_indices)}
    joined = [
        (o.keyframe_frame, o.frame)
        for o in read_loops(folder)
        if o.kept and o.keyframe_frame is not None
    ]
    known = [(place[a], place[b]) for a, b in joined if {a, b} <= place.keys()]
    return [(i, j) for i, j in known if i < j - 1]


def _loops_between(kept: list[int], loops: Sequence[LoopRow]) -> list[tuple[int, int]]:
    """Return the valid loops between some keyframes of a map, by their places among these."""
    place = {k: n for n, k in enumerate(kept)}
    joined = [(o.first, o.second) for o in loops if o.kept]
    return [(place[i], place[j]) for i, j in joined if i in place and j in place]


def _trajectory_of(rows: Sequence[KeyframeRow]) -> Trajectory:
    times_ns = np.array([row.time_ns for row in rows], dtype=np.int64)
    return Trajectory(np.array([row.T_map_cam for row in rows]), times_ns, "cam0")


def _of_map(file: FilePath) -> Placed:
    with contextlib.closing(MapStore(file, read_only=True)) as store:
        sessions = store.sessions()
        rows = store.keyframes()
        loops = store.loops()
    home = sessions[0].part if sessions else 0
    kept = [k for k, row in enumerate(rows) if sessions[row.session].part == home]
    if len(kept) < 2:
        raise DataError(f"{file}: has fewer than two keyframes; there is nothing to place")
    own = [rows[k] for k in kept]
    known = _loops_between(kept, loops)
    trajectory = _trajectory_of(own)
    T = trajectory.T_world_body
    upright = sessions[0].upright
    if upright:
        up = _up_of_map(T, own)
    else:
        up = -T[0, :3, 1]
    path = _path(trajectory, known, up, _UP_RAD if upright else _MOUNT_RAD)
    breaks = np.flatnonzero(np.diff([row.session for row in own])) + 1
    return Placed(file.stem, replace(path, breaks=breaks), trajectory, np.zeros((0, 3)))


def _up_of_map(T_map_cam: FloatArray, rows: Sequence[KeyframeRow]) -> FloatArray:
    """Return the direction (3,) that is up in a map of upright sessions: the mean by its keyframes;
    z where none says.

    A map without loops has the world of its odometry, whose first seconds may have been wrong about
    the vertical.
    """
    seen = [
        (T[:3, :3] @ row.up_cam, row.up_sigma_rad)
        for T, row in zip(T_map_cam, rows, strict=True)
        if row.up_cam is not None
    ]
    if not seen:
        return np.array([0.0, 0.0, 1.0])
    up, sigma = (np.array(values) for values in zip(*seen, strict=True))
    return mean_up(up, sigma)


def _path(
    trajectory: Trajectory, loops: list[tuple[int, int]], up: FloatArray, sigma_rad: float
) -> Path:
    assert trajectory.times_ns is not None
    ends = np.array(loops, dtype=np.int64).reshape(-1, 2)
    none = np.zeros(0, dtype=np.int64)
    return Path(
        trajectory.times_ns, trajectory.T_world_body, ends[:, 0], ends[:, 1], up, sigma_rad, none
    )


def place_on_earth(
    of: Placed, fixes: GnssFixes, lever_arm_m: FloatArray, time_offset_s: float, folder: FilePath
) -> dict[str, Any]:
    """Fuse a trajectory with GNSS positions, write all files into a folder, and return what is said
    of it.

    Args:
        of: the trajectory.
        fixes: positions of an antenna.
        lever_arm_m: (3,) the antenna in the body frame.
        time_offset_s: added to the stamps of the positions.
        folder: exists.

    Raises:
        EstimationError: the positions do not determine its place.
    """
    offset_ns = round(1e9 * time_offset_s)
    found = georeference(of.path, fixes, lever_arm_m, offset_ns)
    doubt = clock_doubt(of.path, fixes, lever_arm_m, offset_ns)
    if doubt is not None:
        logger.warning("%s", doubt)
        fixes = replace(fixes, notes=(*fixes.notes, doubt))
    epsg = _write(
        folder, of, found.frame, found.T_enu_body, found.scale, fixes.geodetic, found.used
    )
    return _facts(of, fixes, found, epsg)


def place_by_map(of: Placed, run: FilePath, file: FilePath, folder: FilePath) -> dict[str, Any]:
    """Place a run on the earth where the map is that it was localised in; as `place_on_earth`.

    The map may have changed since, or be a part of that map, or a merge of it: each pose moves with
    the nearest of the keyframes that the run found.

    Raises:
        DataError: the map is nowhere on the earth, or the run was not localised in it.
    """
    with contextlib.closing(MapStore(file, read_only=True)) as store:
        earth = store.earth()
        rows = store.keyframes()
        sessions = store.sessions()
    if earth is None:
        raise DataError(
            f"{file}: nothing says where it is on the earth; vio georeference {file} GNSS does"
        )
    of_map = None
    if run.is_dir():
        of_map = read_metrics(run)[0].get("map")
    if not isinstance(of_map, dict) or not of_map.get("joined"):
        raise DataError(
            f"{run}: is no run that found its place in a map; vio localise RECORDING --map {file} "
            "makes one"
        )
    home = {
        (row.frame, row.time_ns): row.T_map_cam
        for row in rows
        if sessions[row.session].part == sessions[0].part
    }
    before, now = _common(run, home)
    if len(before) < _COMMON.min_keyframes or not _is_one_path(before, now):
        raise DataError(
            f"{run}: was localised in another map than {file}; give the map that the run found its "
            "place in"
        )
    _, nearest = cKDTree(before[:, :3, 3]).query(of.path.T_map_body[:, :3, 3])
    of = replace(
        of,
        path=replace(of.path, T_map_body=(now @ se3_inverse(before))[nearest] @ of.path.T_map_body),
    )
    frame = LocalFrame(np.array(earth.origin))
    none = np.zeros((0, 3)), np.zeros(0, dtype=np.bool_)
    epsg = _write(folder, of, frame, earth.T_enu_map @ of.path.T_map_body, 1.0, *none)
    return _where(frame, earth.T_enu_map, earth.covariance) | {"crs": epsg}


def _common(
    run: FilePath, home: dict[tuple[int, int], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the poses (K, 4, 4) of a run's keyframes that a map, by frame and time, holds: of
    the run, of the map.
    """
    keyframes = read_keyframes(run)
    (_, T_cam0_body) = read_metrics(run)
    keys = list(zip(keyframes.frame.tolist(), keyframes.time_ns.tolist(), strict=True))
    shared = [n for n, key in enumerate(keys) if key in home]
    T = keyframes.T_map_body[shared] @ se3_inverse(T_cam0_body)
    return T, np.array([home[keys[n]] for n in shared]).reshape(-1, 4, 4)


def _is_one_path(before: FloatArray, now: FloatArray) -> bool:
    """Whether most motions between neighbours of two series of poses (K, 4, 4) agree, as those
    of two maps do not.
    """
    a, b = (se3_log(se3_inverse(T[:-1]) @ T[1:]) for T in (before, now))
    apart = np.linalg.norm(a - b, axis=1)
    return (
        float(np.median(apart - _COMMON.same_share * np.linalg.norm(a, axis=1)))
        < _COMMON.same_motion
    )


def keep_in_map(file: FilePath, facts: dict[str, Any]) -> None:
    """Write into a map where it is on the earth, as `place_on_earth` found it.

    Raises:
        DataError: the file cannot be written.
    """
    origin = facts["origin"]
    where = origin["latitude_deg"], origin["longitude_deg"], origin["height_m"]
    with contextlib.closing(MapStore(file)) as store:
        store.set_earth(
            EarthRow(where, np.array(facts["T_enu_map"]), np.array(facts["covariance"]))
        )


def _write(
    folder: FilePath,
    of: Placed,
    frame: LocalFrame,
    T: FloatArray,
    scale: float,
    fixes: FloatArray,
    used: BoolArray,
) -> str:
    """Write poses (K, 4, 4) in east, north, up and landmarks as files; return the EPSG code of
    UTM.
    """
    write_tum(folder / "trajectory_enu.tum", replace(of.trajectory, T_world_body=T))
    track = frame.geodetic(T[:, :3, 3])
    write_geojson(folder / "trajectory.geojson", of.name, track, fixes, used)
    write_kml(folder / "trajectory.kml", of.name, track)
    epsg = write_utm(folder / "trajectory_utm.csv", track, of.path.times_ns)
    if len(of.points):
        # Each landmark moves with the pose nearest to it.
        T_map = of.path.T_map_body
        _, nearest = cKDTree(T_map[:, :3, 3]).query(of.points)
        before = se3_inverse(T_map[nearest])
        after = T[nearest]
        p = scale * (np.einsum("nij,nj->ni", before[:, :3, :3], of.points) + before[:, :3, 3])
        landmarks = frame.geodetic(np.einsum("nij,nj->ni", after[:, :3, :3], p) + after[:, :3, 3])
        write_points_geojson(folder / "landmarks.geojson", of.name, landmarks)
        write_utm(folder / "landmarks_utm.csv", landmarks)
    return epsg


def _where(frame: LocalFrame, T_enu_map: FloatArray, covariance: FloatArray) -> dict[str, Any]:
    heading, sigma = heading_deg(T_enu_map, covariance)
    latitude, longitude, height = frame.origin.tolist()
    return {
        "origin": {
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "datum": "WGS84",
        },
        "T_enu_map": T_enu_map.tolist(),
        "covariance": covariance.tolist(),
        "heading_deg": heading,
        "heading_sigma_deg": sigma,
    }


def _facts(of: Placed, fixes: GnssFixes, found: Georeference, epsg: str) -> dict[str, Any]:
    r = found.residuals
    used = found.used
    sigma = np.sqrt(np.diagonal(found.position_covariance, axis1=1, axis2=2))
    rigid = found.T_enu_map @ of.path.T_map_body
    bent = np.linalg.norm(rigid[:, :3, 3] - found.T_enu_body[:, :3, 3], axis=1)
    horizontal = np.linalg.norm(r[used, :2], axis=1)
    return _where(found.frame, found.T_enu_map, found.covariance) | {
        "scale": found.scale,
        "scale_sigma": found.scale_sigma,
        "positions": len(fixes),
        "positions_inside": int(found.inside.sum()),
        "positions_used": int(used.sum()),
        "heights_used": int(found.used_height.sum()),
        "residual_median_m": float(np.median(horizontal)),
        "residual_90_m": float(np.percentile(horizontal, 90)),
        "sigma_horizontal_m": float(np.median(np.linalg.norm(sigma[:, :2], axis=1))),
        "sigma_up_m": float(np.median(sigma[:, 2])),
        "bent_rms_m": float(np.sqrt(np.mean(bent**2))),
        "crs": epsg,
        "notes": list(fixes.notes),
    }
