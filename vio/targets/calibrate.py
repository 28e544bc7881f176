"""From the views of a board to calibrated cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import Rig
from vio.errors import CalibrationError, DataError
from vio.filters.imu_terms import ImuTerms
from vio.geometry.lie import FloatArray, se3_inverse, so3_log
from vio.numerics.robust import median
from vio.records import ImuDensities, IntArray
from vio.targets.bundle import Adjusted, BoardAdjustment
from vio.targets.corners import Corners
from vio.targets.description import Target
from vio.targets.diagnosis import clearly_other_board, diagnose, shown_twice
from vio.targets.inertial import BoardPoses, CameraImu, calibrate_imu
from vio.targets.lenses import LENSES, LensChoice, Rival, choose_lens, rivals_of
from vio.targets.recording import Filmed
from vio.targets.start import one_camera, pair_start, pose_only
from vio.targets.verdict import MIN_CORNERS, MIN_VIEWS, Verdict, corners_by_part, judge, part_name
from vio.targets.views import Sightings, sightings


class _ViewRules(NamedTuple):
    """Which views are used, and what of them is doubted."""

    max_views: int = 60
    doubt_sigmas: float = 2.0  # stated, beyond which another lens model's difference is named
    min_doubt_px: float = 0.1
    max_refused_share: float = 0.3  # of a pair's corners, beyond which it is none
    max_residual_px: float = 3.0  # beyond which the board or the lens is another one


_VIEWS = _ViewRules()
_SAME_PLACE_PX = 2.0  # between the corners of two images, below which they show one view
_DOUBTFUL_PX = 0.5  # residual beyond which the images are asked whether the board is the file's
_MAX_TURN_DEG = 60.0  # of a pair's cameras against each other: rectifying turns each by 30 at most


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """Cameras calibrated with a board."""

    rig: Rig
    lens: str  # a key of `LENSES`
    choice: LensChoice | None  # None: the model was asked for
    rivals: tuple[Rival, ...]  # models by which the left camera might be calibrated as well
    found: Adjusted
    seen: Sightings
    alone_sigma_px: tuple[float, ...]  # residual of each camera without the other
    verdict: Verdict


def calibrate_cameras(
    filmed: Filmed,
    target: Target,
    lens: str | None = None,
    progress: Callable[[str], None] = lambda what: None,
) -> CameraCalibration:
    """Calibrate one camera or a pair.

    Args:
        filmed: what they saw of the board.
        target: the board.
        lens: a key of `LENSES`; None: chosen by cross-validation.
        progress: called with what is done next.

    Raises:
        DataError: there are too few views, or the cameras never see the board together.
        CalibrationError: no lens fits: the board is another one.
    """
    _check_views(filmed, target)
    seen = chosen_views(sightings(filmed.views, target.points_m))
    choice: LensChoice | None = None
    if lens is None:
        progress("choose the lens model")
        with _explained(filmed, 0, target):
            choice = choose_lens(seen.of_camera(0), filmed.sizes[0])
        lens = choice.name
    model, count = LENSES[lens]
    progress("adjust each camera")
    alone: list[Adjusted] = []
    for c, size in enumerate(filmed.sizes):
        with _explained(filmed, c, target):
            alone.append(one_camera(seen.of_camera(c), size, model, count))
    for c, one in enumerate(alone):
        _check_fit(one, c, filmed, target)
    found = alone[0]
    if len(alone) > 1:
        progress("adjust the pair")
        start = pair_start(seen, (alone[0], alone[1]))
        found = BoardAdjustment(seen).solve(start)
        _check_pair(found, filmed, target)
    progress("compare halves")
    sigmas = tuple(float(one.sigma_px[0]) for one in alone)
    verdict = judge(found, seen, sigmas)
    rivals: tuple[Rival, ...] = ()
    if choice is not None:
        left = seen.of_camera(0)
        rivals = rivals_of(choice, alone[0].at.cameras[0], left, filmed.sizes[0])
        if (doubt := lens_finding(lens, rivals, verdict)) is not None:
            verdict = replace(verdict, findings=(*verdict.findings, doubt))
    if (twice := _shown_twice(filmed, target)) is not None:
        verdict = replace(verdict, findings=(twice, *verdict.findings))
    rig = _rig_of(found)
    return CameraCalibration(rig, lens, choice, rivals, found, seen, sigmas, verdict)


def lens_finding(lens: str, rivals: tuple[Rival, ...], verdict: Verdict) -> str | None:
    """Return where models that explain the views alike differ by more than is stated, if any do."""
    stated = verdict.inflation * verdict.projection_sigma_px[0]
    beyond: list[tuple[float, str, str]] = []
    for rival in rivals:
        limit = np.maximum(_VIEWS.doubt_sigmas * stated, _VIEWS.min_doubt_px)
        off = np.where(rival.off_px > limit, rival.off_px, 0.0)
        worst = int(np.argmax(off))
        if off[worst] > 0:
            beyond.append((float(off[worst]), rival.name, _place(verdict.grid[0], worst)))
    if not beyond:
        return None
    off_px, name, place = max(beyond)
    return (
        f"the views do not tell the lens models {lens} and {name} apart, which differ by "
        f"{off_px:.2f} px at {place}: show the board there, up to the border of the image"
    )


def _place(grid: FloatArray, number: int) -> str:
    """Return the name of the part of the image in which a pixel of a grid (G, 2) lies."""
    width, height = (grid.max(axis=0) + 1).tolist()
    return part_name(int(np.argmax(corners_by_part(grid[[number]], width, height))))


def calibrate_with_imu(
    filmed: Filmed,
    target: Target,
    cameras: CameraCalibration,
    densities: ImuDensities,
    terms: ImuTerms = "off",
) -> CameraImu:
    """Calibrate the IMU of a recording whose cameras are calibrated.

    `terms`: which of its scales and misalignments are estimated, see `calibrate_imu`.

    Raises:
        DataError: the recording has no IMU, or its motion shows too little; says what to record.
    """
    if filmed.imu is None:
        raise DataError("the recording has no IMU; record its samples with the images")
    seen = sightings(filmed.views, target.points_m)
    left = np.bincount(seen.view[seen.camera == 0], minlength=seen.views)
    chosen = np.flatnonzero(left >= MIN_CORNERS)
    seen = seen.of_views(chosen)
    problem, found = pose_only(cameras.found.at, seen)
    # A view that fits badly has a wrong pose.
    used = np.bincount(seen.view[found.used & (seen.camera == 0)], minlength=seen.views)
    good = np.flatnonzero(used >= MIN_CORNERS)
    times_ns = np.array([filmed.views[v].time_ns for v in chosen[good].tolist()], dtype=np.int64)
    information, xi_D_lens = problem.pose_information(found)
    variance = cameras.verdict.inflation**2
    poses = BoardPoses(
        times_ns,
        found.at.T_cam0_board[good],
        information[good] / variance,
        xi_D_lens[good],
        cameras.found.covariance * variance,
    )
    return calibrate_imu(poses, filmed.imu, densities, terms=terms)


def chosen_views(seen: Sightings) -> Sightings:
    """Return views that hold enough corners, at most `_MAX_VIEWS` spread over the recording, and
    of each camera only images with enough corners.
    """
    image = seen.view * seen.cameras + seen.camera
    counts = np.bincount(image, minlength=seen.views * seen.cameras)
    kept = seen.take(np.flatnonzero(counts[image] >= MIN_CORNERS))
    views: IntArray = np.unique(kept.view)
    if len(views) > _VIEWS.max_views:
        total = np.bincount(kept.view, minlength=seen.views)
        parts = np.array_split(views, _VIEWS.max_views)
        views = np.array([part[np.argmax(total[part])] for part in parts], dtype=np.int64)
    return kept.of_views(views)


def _diagnosis(filmed: Filmed, camera: int, target: Target) -> str | None:
    """Return why the board is not seen as described in the images of a camera, where it shows."""
    return diagnose([images[camera] for images in filmed.samples], target)


@contextmanager
def _explained(filmed: Filmed, camera: int, target: Target) -> Iterator[None]:
    """Give the reason where no lens fits, if the images show one."""
    try:
        yield
    except CalibrationError as error:
        reason = _diagnosis(filmed, camera, target)
        raise (error if reason is None else CalibrationError(reason)) from error


def _check_views(filmed: Filmed, target: Target) -> None:
    names: tuple[str, ...] = ("only",)
    if len(filmed.sizes) > 1:
        names = ("left", "right")
    for c, name in enumerate(names):
        count = sum(len(view.corners[c]) >= MIN_CORNERS for view in filmed.views)
        if count < MIN_VIEWS:
            if (reason := _diagnosis(filmed, c, target)) is not None:
                raise DataError(f"{name} camera: {reason}")
            if count == filmed.frames:
                raise DataError(
                    f"the {name} camera sees the board in all {count} frames, and {MIN_VIEWS} are "
                    "needed: record 30 s of it at several distances and tilts"
                )
            # A checkerboard without markers is counted from its outermost corners.
            whole = "show all of it, " if target.kind == "checkerboard" else ""
            raise DataError(
                f"the {name} camera sees the board in {count} of {filmed.frames} frames, and "
                f"{MIN_VIEWS} are needed; check that the target file is that of the board, {whole}"
                "move it closer, light it well, focus, and record 30 s of it at several distances "
                "and tilts"
            )
        places = _places(filmed, c)
        if places < MIN_VIEWS:
            raise DataError(
                f"the {name} camera sees the board in {count} frames, and of these only {places} "
                f"differ, and {MIN_VIEWS} are needed: move the board or the camera between the images, nearer "
                "and farther, and tilt it"
            )
        images = [images[c] for images in filmed.samples]
        if (other := clearly_other_board(images, target)) is not None:
            raise DataError(f"{name} camera: {other}")
    together = sum(min(map(len, view.corners)) >= MIN_CORNERS for view in filmed.views)
    if together < MIN_VIEWS // 2:
        raise DataError(
            f"the cameras see the board together in {together} frames, and {MIN_VIEWS // 2} are "
            "needed; record it where both images show it"
        )


def _places(filmed: Filmed, camera: int) -> int:
    """Return how many views of a camera differ from each other, at most `MIN_VIEWS`.

    Frames at standstill repeat a view: they average its noise, and show no more of the lens.
    """
    known: list[Corners] = []
    for view in filmed.views:
        corners = view.corners[camera]
        if len(corners) < MIN_CORNERS:
            continue
        if all(_apart_px(corners, other) > _SAME_PLACE_PX for other in known):
            known.append(corners)
        if len(known) == MIN_VIEWS:
            break
    return len(known)


def _apart_px(a: Corners, b: Corners) -> float:
    """Return the median distance of the corners that two images show; infinite: they show none."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    if not len(in_a):
        return float("inf")
    return median(np.linalg.norm(a.uv[in_a] - b.uv[in_b], axis=1))


def _check_fit(one: Adjusted, camera: int, filmed: Filmed, target: Target) -> None:
    residual = median(np.linalg.norm(one.residuals_px, axis=1))
    if residual < _DOUBTFUL_PX:
        return
    reason = _diagnosis(filmed, camera, target)
    if reason is not None or residual > _VIEWS.max_residual_px:
        advice = reason or "check rows, columns, tag spacing and numbering in the target file"
        raise CalibrationError(
            f"camera {camera}: corners are off by {residual:.1f} px (median) with the best lens; "
            f"{advice}"
        )


def _shown_twice(filmed: Filmed, target: Target) -> str | None:
    """Return whether images of any camera show two boards."""
    return shown_twice([image for images in filmed.samples for image in images], target)


def _check_pair(found: Adjusted, filmed: Filmed, target: Target) -> None:
    """Refuse images that are no pair, or exchanged."""
    refused = float(np.mean(~found.used))
    off_px = float(found.sigma_px.max())
    if refused > _VIEWS.max_refused_share or off_px > _VIEWS.max_residual_px:
        if (twice := _shown_twice(filmed, target)) is not None:
            raise DataError(twice)
        raise DataError(
            "left and right images are not of the same moments: corners fit each camera alone, and "
            f"with one pose of the right camera they are off by {off_px:.0f} px, "
            f"{100 * refused:.0f} % of them by more; pair the images by their times, or hold the "
            "board still for each pair"
        )
    T_cam1_cam0 = found.at.T_cam_cam0[1]
    turn_deg = float(np.degrees(np.linalg.norm(so3_log(T_cam1_cam0[:3, :3]))))
    if turn_deg > _MAX_TURN_DEG:
        raise DataError(
            f"the right camera is turned by {turn_deg:.0f} degrees against the left one: turn the "
            "images of one of them, or calibrate each camera alone"
        )
    x, y, _ = (se3_inverse(T_cam1_cam0)[:3, 3]).tolist()
    if x < -abs(y):
        raise DataError(
            "the right camera is to the left of the left one, as its images see it: exchange left "
            "and right images, as is also needed where both cameras are mounted upside down"
        )


def _rig_of(found: Adjusted) -> Rig:
    cameras = found.at.cameras
    if len(cameras) == 1:
        return Rig(cameras[0])
    return Rig(cameras[0], cameras[1], found.at.T_cam_cam0[1])
