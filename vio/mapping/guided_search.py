"""Where a keyframe stands, by looking for the points of a place where they should be seen.

Where the motion to a place is roughly known, each of its points competes only with the few features
around its predicted pixel, in place of all features of the image (search by projection, as in
Mur-Artal et al. 2015). Points come from several keyframes, so that one of them shows each from a
similar view.

A window always holds some feature that looks alike. What agrees by chance is counted with the same
search where all points are moved aside, and a place needs several times as many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.calibration.stereo_field import DisplacementField
from vio.geometry.lie import FloatArray, se3_inverse, so3_hat, transform_points
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, p_cam_D_z, project, triangulate
from vio.mapping.features import MAX_BITS, KeyframeFeatures
from vio.mapping.loop_geometry import (
    MIN_DISPARITY_PX,
    Fitted,
    StereoPoints,
    Terms,
    covariance_by_shifts,
    differing_bits,
    fit_terms,
    points_of,
    pose_of_most,
)
from vio.mapping.overlap import MIN_DEPTH_M, SCALES, VIEW_COS
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity
from vio.records import IntArray


class _Guidance(NamedTuple):
    """How points of a place are looked for."""

    # by which the size of a feature differs from the predicted one: two and a half levels
    levels: float = 1.6
    # half of a window's side at the scale of its feature, where the pose is known
    window_px: float = 3.0
    # half of a window's side: in larger ones, the best of all descriptors is seldom the point's
    max_window_px: float = 40.0
    searches: int = 2  # with the pose found
    min_sample: int = 8  # pairs that agree before the next search
    # features closer together are of one corner, on several levels of the pyramid, and count once
    cell_px: float = 8.0
    rows: Capacity[int] = 1 << 20  # more than an image has
    # by which all points are moved to find the pairs of chance: more than a window of the last
    # search
    aside_px: float = 25.0
    aside: int = 8  # directions
    # Times the mean number of corners of chance; or half as many times beside MIN_CORNERS, which
    # is less where chance is above 4: large means scatter less. Of searches at wrong poses none
    # had more than 1.9 times beside MIN_CORNERS there.
    over_chance: float = 6.0
    # Share of the odometry's information in the measurement, since the map has it already: enough
    # to hold what the pixels leave open to where the covariance is linear.
    prior_share: float = 0.1


_GUIDANCE = _Guidance()
_SIGMAS = 3.0
MIN_CORNERS = 12


class Shown(NamedTuple):
    """The stereo points that a keyframe shows."""

    camera: StereoCamera
    features: KeyframeFeatures
    row: IntArray  # (N,) feature of each
    p: FloatArray  # (N, 3) in the keyframe's camera
    size_px: FloatArray  # (N,) of the feature
    descriptors: npt.NDArray[np.uint64]  # (N, 4)


class PlaceView(NamedTuple):
    """A keyframe of a place."""

    keyframe: int
    shown: Shown
    place: RelativePose  # in the frame of the place's first keyframe
    # keyframe in the middle of its segment of the path, along which the odometry knows the motions
    middle: int = 0


@dataclass(frozen=True, slots=True)
class PlacePoints:
    """The stereo points of a place, once for each keyframe that shows them."""

    views: Sequence[PlaceView]
    p: FloatArray  # (N, 3) in the frame of the place's first keyframe
    eye: FloatArray  # (N, 3) position of the camera that saw it, likewise
    size_px: FloatArray  # (N,) of the feature
    descriptors: npt.NDArray[np.uint64]  # (N, 4)
    view: IntArray  # (N,) index of the keyframe in the place
    row: IntArray  # (N,) feature of that keyframe

    def take(self, rows: IntArray) -> PlacePoints:
        """Return some of the points."""
        a = self.p[rows], self.eye[rows], self.size_px[rows], self.descriptors[rows]
        return PlacePoints(self.views, *a, self.view[rows], self.row[rows])

    def main_segment(self) -> IntArray:
        """Return the points (K,) of the segment of the path that shows most of them."""
        middle = np.array([view.middle for view in self.views])[self.view]
        values, counts = np.unique(middle, return_counts=True)
        return np.flatnonzero(middle == values[np.argmax(counts)])

    def with_covariance(self) -> StereoPoints:
        """Return the points with their covariance; errors of the keyframes' poses count as those
        of their points.
        """
        P = np.zeros((len(self.p), 3, 3))
        for n in np.unique(self.view).tolist():
            source = self.views[n].shown
            place = self.views[n].place
            own = self.view == n
            seen = points_of(source.camera, source.features, self.row[own])
            D = np.concatenate(
                [np.broadcast_to(np.eye(3), (len(seen.p), 3, 3)), -so3_hat(seen.p)], axis=2
            )
            R = place.T_i_j[:3, :3]
            by_place = D @ place.covariance @ np.swapaxes(D, 1, 2)
            P[own] = R @ (seen.covariance + by_place) @ R.T
        return StereoPoints(self.p, P, np.ones(len(P), dtype=np.bool_))

    def fields(self) -> list[DisplacementField | None]:
        """Return the rectification error (K,) that was taken out of each point's pixels."""
        return [self.views[n].shown.features.field for n in self.view.tolist()]

    def shifts(self, field: DisplacementField) -> FloatArray:
        """Return by how much one standard deviation of a field's combinations moves the points
        (K, 3, S).
        """
        out = np.zeros((len(self.p), 3, field.coefficients.size))
        for n in np.unique(self.view).tolist():
            camera, f, *_ = self.views[n].shown
            own = self.view == n
            if f.field is field:
                z = f.z[self.row[own]]
                out[own] = (
                    self.views[n].place.T_i_j[:3, :3] @ p_cam_D_z(camera, z) @ field.deviations(z)
                )
        return out


@dataclass(frozen=True, slots=True)
class Guided:
    """A place found by search."""

    pose: RelativePose  # of the camera in the frame of the place's first keyframe
    inliers: int  # distinct corners
    chance: float  # mean number of those where all points are moved aside
    view: IntArray  # (P,) keyframe of the place that shows each pair
    row: IntArray  # (P,) feature of that keyframe
    row_here: IntArray  # (P,) feature of this keyframe


def shown(camera: StereoCamera, features: KeyframeFeatures) -> Shown:
    """Return the stereo points of a keyframe."""
    p, valid = triangulate(camera, features.z, min_disparity_px=MIN_DISPARITY_PX)
    row = np.flatnonzero(valid & features.has_right)
    return Shown(
        camera, features, row, p[row], features.sigma_px[row], _as_words(features.descriptors[row])
    )


def place_points(views: Sequence[PlaceView]) -> PlacePoints:
    """Return the points that the keyframes of a place show."""
    each = [view.shown for view in views]
    p = np.concatenate([transform_points(view.place.T_i_j, view.shown.p) for view in views])
    view = np.repeat(np.arange(len(views)), [len(s.row) for s in each])
    eye = np.array([v.place.T_i_j[:3, 3] for v in views])[view]
    size_px, descriptors, row = (
        np.concatenate(x)
        for x in zip(*((s.size_px, s.descriptors, s.row) for s in each), strict=True)
    )
    return PlacePoints(views, p, eye, size_px, descriptors, view, row)


def _as_words(descriptors: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint64]:
    return np.ascontiguousarray(descriptors).view(np.uint64)


def search(
    place: PlacePoints,
    camera: StereoCamera,
    here: KeyframeFeatures,
    start: RelativePose,
    prior: RelativePose | None,
) -> Guided | None:
    """Return where a keyframe stands in the frame of a place; None: not enough of the place is
    seen.

    Args:
        place: the place's points.
        camera: of the keyframe.
        here: its features.
        start: about where it stands; the covariance gives the windows of the first search.
        prior: where it stands by the odometry: it decides which pairs agree, and what the pixels
            leave open; pose and covariance of the result are those of the pixels; None: not known.
    """
    if len(here) < MIN_CORNERS:
        return None
    target = _Target.of(camera, here)
    place = place.take(_in_reach(place, camera, start.T_i_j))
    pairs = _pairs(place, target, start.T_i_j, start.covariance)
    seen_from = pose_of_most(
        camera, place.p[pairs.point], here.z[pairs.feature, :2], _GUIDANCE.min_sample
    )
    T = None if seen_from is None else se3_inverse(seen_from)
    fitted = None
    for _ in range(_GUIDANCE.searches):
        if T is None:
            return None
        pairs = _pairs(place, target, T, None)
        points = place.take(pairs.point)
        rows = pairs.feature
        stereo = points.with_covariance()
        fitted = fit_terms(
            [Terms(stereo, camera, here, rows, inverse=True)], T, prior=prior, least=MIN_CORNERS
        )
        T = None if fitted is None else fitted.T_i_j
    if fitted is None:
        return None
    agree = np.flatnonzero(fitted.fits)
    inliers = _corners(here.z[rows[agree]])
    if inliers < MIN_CORNERS:
        return None
    chance = _chance(pairs, target)
    if inliers < min(
        _GUIDANCE.over_chance * chance, MIN_CORNERS + 0.5 * _GUIDANCE.over_chance * chance
    ):
        return None
    own = _of_one_segment(points, here, rows, agree)
    weak = _weakened(prior)
    terms = Terms(stereo.take(own), camera, here, rows[own], inverse=True)
    measured = fit_terms([terms], fitted.T_i_j, prior=weak, least=_GUIDANCE.min_sample)
    if measured is None:
        return None
    by_fields = _covariance_by_fields(
        points.take(own), here, rows[own], terms, measured.T_i_j, weak
    )
    return _guided(measured, points.take(own), rows[own], inliers, chance, by_fields)


def _covariance_by_fields(
    points: PlacePoints,
    here: KeyframeFeatures,
    rows: IntArray,
    terms: Terms,
    T_i_k: FloatArray,
    prior: RelativePose | None,
) -> FloatArray:
    """Covariance (6, 6) of a fitted pose by what is not known of the rectification errors, which
    sessions share.
    """
    fields = {id(f): f for f in (*points.fields(), here.field) if f is not None}
    total = np.zeros((6, 6))
    for field in fields.values():
        z = here.z[rows]
        dz = (
            field.deviations(z)
            if here.field is field
            else np.zeros((*z.shape, field.coefficients.size))
        )
        total += covariance_by_shifts(terms, T_i_k, prior, points.shifts(field), dz)
    return total


def _of_one_segment(
    points: PlacePoints, here: KeyframeFeatures, rows: IntArray, agree: IntArray
) -> IntArray:
    """Return those of the pairs that `agree` which are of the segment that shows most of them, or
    all if too few are.

    How segments stand to each other is what the map says so far, which is not to come back as a
    measurement.
    """
    own = agree[points.take(agree).main_segment()]
    if _corners(here.z[rows[own]]) >= MIN_CORNERS:
        return own
    return agree


def _guided(
    measured: Fitted,
    points: PlacePoints,
    rows: IntArray,
    inliers: int,
    chance: float,
    by_fields: FloatArray,
) -> Guided:
    """Return a place by the fit to pairs of its points and features `rows` (P,)."""
    found = points.take(np.flatnonzero(measured.fits))
    rows = rows[measured.fits]
    depth = float(np.median(transform_points(se3_inverse(measured.T_i_j), found.p)[:, 2]))
    motion = measured.motion(depth)
    pose = RelativePose(motion.T_i_j, motion.covariance + by_fields)
    return Guided(pose, inliers, chance, found.view, found.row, rows)


def _in_reach(place: PlacePoints, camera: StereoCamera, T_i_k: FloatArray) -> IntArray:
    """Return the points (K,) that may be seen from about a pose (4, 4)."""
    q = transform_points(se3_inverse(T_i_k), place.p)
    ahead = np.flatnonzero(q[:, 2] > 0)
    uv = project(camera, q[ahead])[:, :2]
    margin = _GUIDANCE.max_window_px + _GUIDANCE.aside_px
    w = camera.width or np.inf
    h = camera.height or np.inf
    after_begin = (uv > -margin).all(axis=1)
    before_end = (uv < [w + margin, h + margin]).all(axis=1)
    return ahead[after_begin & before_end]


class _Target(NamedTuple):
    """A keyframe whose features are looked through, in the order of their columns."""

    camera: StereoCamera
    order: IntArray  # (M,) features
    z: FloatArray  # (M, 4)
    size_px: FloatArray  # (M,)
    descriptors: npt.NDArray[np.uint64]  # (M, 4)

    @classmethod
    def of(cls, camera: StereoCamera, f: KeyframeFeatures) -> _Target:
        """Order the features of a keyframe."""
        order = np.argsort(f.z[:, 0], kind="stable")
        return cls(camera, order, f.z[order], f.sigma_px[order], _as_words(f.descriptors[order]))


class _Pairs(NamedTuple):
    """Points that should be seen, and the features that look like them."""

    point: IntArray  # (P,)
    feature: IntArray  # (P,) each once
    uv: FloatArray  # (N, 2) predicted pixels of all points that should be seen
    radius: FloatArray  # (N,) half of the window's side
    size_px: FloatArray  # (N,) of the feature, as predicted
    descriptors: npt.NDArray[np.uint64]  # (N, 4)


def _pairs(
    place: PlacePoints, target: _Target, T_i_k: FloatArray, covariance: FloatArray | None
) -> _Pairs:
    """Pair points with features: for each feature the point that looks most alike and should be
    there.

    Args:
        place: points.
        target: features.
        T_i_k: (4, 4) pose of the keyframe that shows them.
        covariance: (6, 6) of xi in T_i_k = T_hat exp(xi); None: the pose is known.
    """
    c = target.camera
    uv = np.zeros((len(place.p), 2))
    radius = np.zeros(len(place.p))
    size = place.size_px.copy()
    if covariance is None:
        C = np.zeros((6, 6))
    else:
        C = _SIGMAS**2 * covariance
    width = c.width or np.inf
    height = c.height or np.inf
    camera = np.array([c.fu, c.fv, c.cu, c.cv, width, height])
    points = _SeenFrom(place.p, place.eye)
    pose = _Pose(se3_inverse(T_i_k), T_i_k[:3, 3], C)
    _predict(points, pose, camera, uv, radius, size)
    seen = np.flatnonzero(radius > 0)
    uv = uv[seen]
    radius = radius[seen]
    size = size[seen]
    descriptors = place.descriptors[seen]
    best, bits = _looked_for(uv, radius, size, descriptors, target)
    found = np.flatnonzero(best >= 0)
    found = found[np.argsort(bits[found], kind="stable")]
    feature, first = np.unique(best[found], return_index=True)
    return _Pairs(seen[found[first]], target.order[feature], uv, radius, size, descriptors)


def _looked_for(
    uv: FloatArray,
    radius: FloatArray,
    size: FloatArray,
    descriptors: npt.NDArray[np.uint64],
    target: _Target,
) -> tuple[IntArray, IntArray]:
    """Return for each point (N,) the place of its feature in the target's order, or -1, and
    their differing bits.
    """
    best = np.full(len(uv), -1, dtype=np.int64)
    bits = np.zeros(len(uv), dtype=np.int64)
    windows = _Windows(uv, radius, size, descriptors)
    features = _Features(target.z, target.size_px, target.descriptors)
    _best_in_windows(windows, features, best, bits)
    return best, bits


class _SeenFrom(NamedTuple):
    """Points, and the cameras that saw them."""

    p: FloatArray  # (N, 3)
    eye: FloatArray  # (N, 3) positions of the cameras


class _Pose(NamedTuple):
    """Where the camera is that looks for points."""

    T: FloatArray  # (4, 4) maps points to the camera
    here: FloatArray  # (3,) its position
    # (6, 6) covariance, times the square of the standard deviations that a window has
    covariance: FloatArray


class _Windows(NamedTuple):
    """Where points are looked for, and how they look."""

    uv: FloatArray  # (N, 2) pixels
    radius: FloatArray  # (N,) half of a window, pixels
    size_px: FloatArray  # (N,) of the features
    descriptors: npt.NDArray[np.uint64]  # (N, 4)


class _Features(NamedTuple):
    """The features of a keyframe in the order of their columns."""

    z: FloatArray  # (M, 4) pixels
    size_px: FloatArray  # (M,)
    descriptors: npt.NDArray[np.uint64]  # (M, 4)


@compiled
def _distances(p: FloatArray, eye: FloatArray, here: FloatArray) -> tuple[float, float, bool]:
    """Return how far a point is from where it was seen and from here, and whether it looks alike
    from both: in direction and size.
    """
    dot = 0.0
    away = 0.0
    near = 0.0
    for i in range(3):
        there = p[i] - eye[i]
        now = p[i] - here[i]
        dot = dot + there * now
        away = away + there * there
        near = near + now * now
    away = np.sqrt(away)
    near = np.sqrt(near)
    alike = dot > VIEW_COS * away * near and 1 / SCALES < away / near < SCALES
    return away, near, alike


@compiled
def _largest_variance(D: FloatArray, C: FloatArray) -> float:
    """Return the larger variance of a pixel's coordinates, by its Jacobian (2, 6) and the pose's
    covariance (6, 6).
    """
    largest = 0.0
    for r in range(2):
        total = 0.0
        for i in range(6):
            for j in range(6):
                total += D[r, i] * C[i, j] * D[r, j]
        largest = max(largest, total)
    return largest


@compiled
def _predict(
    points: _SeenFrom,
    pose: _Pose,
    camera: FloatArray,
    uv: FloatArray,
    radius: FloatArray,
    size: FloatArray,
) -> None:
    """Predict pixels (N, 2), half windows (N,), 0 where a point should not be seen, and sizes of
    features (N,).

    Args:
        points: those that are looked for.
        pose: of the camera.
        camera: [fu fv cu cv width height].
        uv: pixels, written.
        radius: windows, written.
        size: of the features in their keyframes; replaced.
    """
    p = points.p
    T = pose.T
    C = pose.covariance
    fu, fv, cu, cv, width, height = camera
    D = np.zeros((2, 6))
    q = np.zeros(3)
    for n in range(len(p)):
        for i in range(3):
            q[i] = T[i, 0] * p[n, 0] + T[i, 1] * p[n, 1] + T[i, 2] * p[n, 2] + T[i, 3]
        away, near, alike = _distances(p[n], points.eye[n], pose.here)
        if q[2] <= MIN_DEPTH_M or not alike:
            continue
        u = cu + fu * q[0] / q[2]
        v = cv + fv * q[1] / q[2]
        # uv_D_xi of q = exp(-xi) T p: [-J, J q^], with J = uv_D_q.
        a = fu / q[2]
        b = fv / q[2]
        x = q[0] / q[2]
        y = q[1] / q[2]
        D[0, 0] = -a
        D[0, 2] = a * x
        D[1, 1] = -b
        D[1, 2] = b * y
        D[0, 3] = a * x * q[1]
        D[0, 4] = -a * (q[2] + x * q[0])
        D[0, 5] = a * q[1]
        D[1, 3] = b * (q[2] + y * q[1])
        D[1, 4] = -b * y * q[0]
        D[1, 5] = -b * q[0]
        largest = _largest_variance(D, C)
        size[n] = size[n] * away / near
        half = _GUIDANCE.window_px * max(size[n], 1.0) + np.sqrt(largest)
        if (
            half <= _GUIDANCE.max_window_px
            and -half < u < width + half
            and -half < v < height + half
        ):
            uv[n, 0] = u
            uv[n, 1] = v
            radius[n] = half


@compiled
def _best_in_windows(
    windows: _Windows, features: _Features, best: IntArray, bits: IntArray
) -> None:
    """Find for each point the feature (N,) around its pixel whose descriptor differs least; -1:
    none does well.
    """
    uv = windows.uv
    radius = windows.radius
    z = features.z
    for i in range(len(uv)):
        least = np.uint64(MAX_BITS + 1)
        j = np.searchsorted(z[:, 0], uv[i, 0] - radius[i])
        while j < len(z) and z[j, 0] <= uv[i, 0] + radius[i]:
            ratio = features.size_px[j] / windows.size_px[i]
            if (
                abs(z[j, 1] - uv[i, 1]) <= radius[i]
                and ratio < _GUIDANCE.levels
                and ratio * _GUIDANCE.levels > 1.0
            ):
                total = differing_bits(windows.descriptors[i], features.descriptors[j])
                if total < least:
                    least = total
                    best[i] = j
            j += 1
        bits[i] = least


def _corners(z: FloatArray) -> int:
    """Count the parts of the image that features (P, 4) are in."""
    cell = (z[:, :2] // _GUIDANCE.cell_px).astype(np.int64)
    return len(np.unique(cell[:, 0] * _GUIDANCE.rows + cell[:, 1]))


def _weakened(prior: RelativePose | None) -> RelativePose | None:
    """Return the prior with the covariance that decides what the pixels leave open."""
    if prior is None:
        return None
    return RelativePose(prior.T_i_j, prior.covariance / _GUIDANCE.prior_share)


def _chance(pairs: _Pairs, target: _Target) -> float:
    """Return the mean number of corners that pair where no point is where it should be."""
    counts = []
    for angle in np.linspace(0, 2 * np.pi, _GUIDANCE.aside, endpoint=False):
        aside = pairs.uv + _GUIDANCE.aside_px * np.array([np.cos(angle), np.sin(angle)])
        best, _ = _looked_for(aside, pairs.radius, pairs.size_px, pairs.descriptors, target)
        counts.append(_corners(target.z[best[best >= 0]]))
    return float(np.mean(counts))
