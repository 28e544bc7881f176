"""The field of pixels that a stereo calibration is off by, and the calibration that has none.

The sliding window estimates a low-order field over the rectified images, equations (R1) to (R3) of
docs/math.md. Here it is taken out of pixels, and turned into a rig: a rotation of the right camera,
its principal point, focal lengths and tangential distortion against the left one, the distortion of
both, and how far the right camera sits below the row of the left one. The field's coefficients
determine these parameters to first order, but three of them badly (a yaw, a principal point and a
tangential distortion of the right camera move pixels almost alike); a prior of what real rigs do
decides between them. The term of the fourth order of the right columns has no parameter and is
left.
"""

from __future__ import annotations

import math
from dataclasses import field as dataclass_field
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import error_basis, radial_focal
from vio.cameras.rig import Rig, rig_of_rectified
from vio.dataclass import dataclass
from vio.errors import CalibrationError
from vio.geometry.distortion import (
    CameraModel,
    holds_distortion,
    project_point,
    rectified_pair,
)
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.rectify import MapArray, rectified_cameras, rectify_pixels
from vio.geometry.stereo import StereoCamera, left_rays
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import (
    FIELD_TERMS,
    RIGHT_TERMS,
    ROW_TERMS,
    BoolArray,
    Estimate,
    StereoFieldEstimate,
    StereoScaleEstimate,
)

# Parameters of a rig's correction: rotation of the right camera (rad, in the rectified frame: its
# points p are seen as `exp(w) p`), its principal point (focal lengths), focal ratios and tangential
# distortion against the left camera; radial distortion of both, of the third and fifth order, and
# tangential; how far the right camera is below the left one's row (baselines).
PARAMETERS = ("wx", "wy", "wz", "cu", "cv", "fu", "fv", "p1", "p2", "k", "k2", "q1", "q2", "ty")
_BOTH = ("k", "k2", "q1", "q2")
TERMS = FIELD_TERMS + ROW_TERMS  # coefficients of the field: of (R3), then of the rows (R2)
_FOURTH = RIGHT_TERMS - 1  # the one of them that no rig has
_BELOW = TERMS - 1  # the one of the baseline's direction
# What a calibration of a real rig is usually off by: mounts turn by tenths of a degree; principal
# point and focal lengths by 2e-3 focal lengths; lens models as the sliding window takes them
# (online_calibration). A Cauchy distribution of this width: a rig that is off by much more is
# believed.
_PRIOR = np.array(
    [*[np.radians(0.5)] * 3, *[2e-3] * 4, *[2e-3] * 2, 1e-2, 1e-2, *[2e-3] * 2, np.radians(0.5)]
)


class _FieldRules(NamedTuple):
    """What the field of a calibration says of its parameters."""

    # focal lengths, 0.05 px: what terms beyond those of the field leave in a coefficient
    model_sigma: float = 1e-4
    unknown_sigma: float = 1.0  # focal lengths: a coefficient that says nothing of the rig
    named_sigmas: float = 3.0  # a parameter within so many standard deviations of zero is not named
    # a rig that leaves more of what the run saw is none of these cameras; true ones leave 0.3 px
    max_left_px: float = 5.0


_FIELD = _FieldRules()
# models that hold tangential distortion, or become one that does
# of the parameters that a lens model may hold: k1 k2, and p1 p2
_LENS_PARAMETERS = {
    "k": ((1.0, 0.0), (0.0, 0.0)),
    "k2": ((0.0, 1.0), (0.0, 0.0)),
    "p1": ((0.0, 0.0), (1.0, 0.0)),
    "p2": ((0.0, 0.0), (0.0, 1.0)),
    "q1": ((0.0, 0.0), (1.0, 0.0)),
    "q2": ((0.0, 0.0), (0.0, 1.0)),
}
_GRID = (11, 9)  # points along the image's width and height at which field and rig are compared


class _FitRules(NamedTuple):
    """The numeric fit of the parameters."""

    # of numeric derivatives by the parameters, which are all of the size of radians
    step_rad: Tolerance[float] = 1e-6
    max_steps: Tolerance[int] = 15  # of Gauss-Newton; the weights of the prior need them
    settled_sigmas: Tolerance[float] = (
        1e-4  # standard deviations of a step after which there is no other
    )
    # logarithm of a factor of the focal lengths: of beyond, powers overflow
    max_log_focal: Capacity[float] = 10.0


_FIT = _FitRules()
# of these steps: at the given rig and near the solution; the others find the same one
_LINEARISED: Tolerance[tuple[int, int]] = (0, 4)
_TEXT = {
    "wx": ("right camera turned by {} deg about its horizontal axis", 180 / np.pi, ".3f"),
    "wy": ("right camera turned by {} deg about its vertical axis", 180 / np.pi, ".3f"),
    "wz": ("right camera turned by {} deg about its optical axis", 180 / np.pi, ".3f"),
    "fu": ("its focal length along u off by {} %", 100.0, ".3f"),
    "fv": ("its focal length along v off by {} %", 100.0, ".3f"),
    "p1": ("its tangential distortion p1 off by ({}) x 1e-3", 1e3, ".2f"),
    "p2": ("its tangential distortion p2 off by ({}) x 1e-3", 1e3, ".2f"),
    "k": ("radial distortion k1 of both lenses off by ({}) x 1e-3", 1e3, ".2f"),
    "k2": ("radial distortion k2 of both lenses off by ({}) x 1e-3", 1e3, ".2f"),
    "q1": ("tangential distortion p1 of both lenses off by ({}) x 1e-3", 1e3, ".2f"),
    "q2": ("tangential distortion p2 of both lenses off by ({}) x 1e-3", 1e3, ".2f"),
    "ty": ("right camera {} % of the baseline below the left one's row", 100.0, ".3f"),
}


def disparity_off(field: StereoFieldEstimate) -> tuple[float, float]:
    """Return by which disparities are too large in the middle of the image, and its standard
    deviation, focal lengths.

    Terms beyond those of the field count in it as they do for a rig of that field: a run on the
    calibration that another run saved may find as much.
    """
    variance = float(field.covariance[0, 0]) + _FIELD.model_sigma**2
    return -float(field.coefficients[0]), math.sqrt(variance)


@dataclass(frozen=True, slots=True)
class DisplacementField:
    """How far the pixels of a rectified pair are off, as a run estimated it."""

    camera: StereoCamera
    coefficients: FloatArray  # (15,) of (R3) and of the rows (R2), in focal lengths
    covariance: FloatArray | None = None  # (15, 15) of the coefficients; None: they count as known

    @classmethod
    def of(cls, camera: StereoCamera, estimate: StereoFieldEstimate) -> DisplacementField:
        """Return the field of an estimate, without rows where they are not known."""
        coefficients = np.zeros(TERMS)
        covariance = np.zeros((TERMS, TERMS))
        coefficients[:FIELD_TERMS] = estimate.coefficients
        covariance[:FIELD_TERMS, :FIELD_TERMS] = estimate.covariance
        if estimate.rows is not None:
            coefficients[FIELD_TERMS:] = estimate.rows
        if estimate.rows_covariance is not None:
            covariance[FIELD_TERMS:, FIELD_TERMS:] = estimate.rows_covariance
        return cls(camera, coefficients, covariance)

    def at(self, z: FloatArray) -> FloatArray:
        """Return how far pixels `[ul vl ur vr]` (N, 4) are off, (N, 4) pixels."""
        return error_basis(self.camera, z) @ self.coefficients

    def without(self, z: FloatArray, has_right: BoolArray) -> FloatArray:
        """Return pixels (N, 4) without the field; right pixels stay as they are where
        `has_right` (N,) is False.
        """
        off = self.at(z)
        off[~has_right, 2:] = 0
        return z - off

    def deviations(self, z: FloatArray) -> FloatArray:
        """Return by how much pixels (N, 4) move (N, 4, 15) for one standard deviation of
        independent combinations.
        """
        if self.covariance is None:
            return np.zeros((*z.shape, TERMS))
        variances, V = np.linalg.eigh(self.covariance)
        return error_basis(self.camera, z) @ (V * np.sqrt(np.maximum(variances, 0.0)))

    def maps(self) -> tuple[tuple[MapArray, MapArray], tuple[MapArray, MapArray]]:
        """Return where each pixel of the left and right images without the field lies in the images
        as they are.

        Source u and v (H, W) of both, for cv2.remap.
        """
        assert self.camera.width is not None
        assert self.camera.height is not None
        out = np.empty((4, self.camera.height, self.camera.width), dtype=np.float32)
        u = np.arange(self.camera.width, dtype=np.float64)
        for row in range(self.camera.height):
            v = np.full_like(u, row)
            z = np.stack([u, v, u, v], axis=1)
            seen = z + self.at(z)
            seen[:, 3] = v  # (R2) and (R3) take the row of the left image
            out[:, row] = (z + self.at(seen)).T
        return (out[0], out[1]), (out[2], out[3])


@dataclass(frozen=True, slots=True)
class CalibratedRig:
    """A rig as a run corrected it."""

    rig: Rig
    # (14,) what the given rig was off by, in the order and units of `PARAMETERS`
    parameters: FloatArray
    covariance: FloatArray  # (14, 14)
    left_px: float  # root mean square over the images of the field that the rig cannot express
    # what baseline and focal length were off by, where they were estimated
    scale: StereoScaleEstimate | None = None

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (14,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def with_turned(self, rotation: FloatArray, given: Rig) -> CalibratedRig:
        """Return the rig whose right camera is turned besides: by `rotation` (3,) rad in the
        rectified frame of the given rig, by which images were turned back before anything was
        estimated in them.

        Parameters of turns add up to first order.
        """
        R_rect_cam1 = _Frame.of(given).R_rect_cam1
        cam1, T_cam1_cam0 = self.rig.right
        R = R_rect_cam1.T @ so3_exp(rotation) @ R_rect_cam1
        T = se3_from_parts(R, np.zeros(3)) @ T_cam1_cam0
        parameters = self.parameters.copy()
        parameters[:3] += rotation
        rig = replace(self.rig, cam1=cam1, T_cam1_cam0=T)
        return replace(self, rig=rig, parameters=parameters)

    def lines(self) -> tuple[str, ...]:
        """Return one line for each parameter that is off by more than three standard deviations.

        A turn about the vertical or horizontal axis and a principal point move the image's centre
        alike, and only their sum is well determined: it is the turn that is named.
        """
        combine = np.eye(len(PARAMETERS))
        for turn, centre, sign in (("wx", "cv", -1.0), ("wy", "cu", 1.0)):
            combine[PARAMETERS.index(turn), PARAMETERS.index(centre)] = sign
        values = combine @ self.parameters
        covariance = combine @ self.covariance @ combine.T
        out = []
        for name, value, variance in zip(
            PARAMETERS, values.tolist(), np.diag(covariance).tolist(), strict=True
        ):
            if name in _TEXT and value * value > _FIELD.named_sigmas**2 * variance:
                text, scale, form = _TEXT[name]
                out.append(text.format(f"{scale * value:+{form}} ± {scale * variance**0.5:{form}}"))
        if self.scale is None:
            found = {}
        else:
            found = self.scale.percent()
        out += [
            f"{name} off by {percent:+.2f} ± {sigma:.2f} %"
            for name, (percent, sigma) in found.items()
        ]
        return tuple(out)


def calibrated_rig(given: Rig, estimate: Estimate) -> CalibratedRig:
    """Return a given rig with all that a run estimated of it.

    That is the rectification error, baseline and focal length, extrinsics and time offset of the
    IMU.

    What the run did not estimate stays as given, with its prior standard deviations.

    Raises:
        CalibrationError: the given rig cannot be rectified.
    """
    field = estimate.stereo_field
    known = field is not None and field.rows is not None and field.rows_covariance is not None
    if known:
        assert field is not None
        out = _with_field(given, field)
    else:
        out = CalibratedRig(given, np.zeros(len(PARAMETERS)), np.diag(_PRIOR**2), 0.0)
    rig = out.rig
    if estimate.T_cam0_imu is not None:
        # images of one camera are not turned
        R_cam0_rect = np.eye(3) if given.cam1 is None else _Frame.of(given).R_rect_cam0.T
        rig = replace(
            rig, T_cam0_imu=se3_from_parts(R_cam0_rect, np.zeros(3)) @ estimate.T_cam0_imu
        )
    if estimate.time_offset_s is not None:
        rig = replace(rig, time_offset_s=given.time_offset_s + estimate.time_offset_s)
    if estimate.stereo_scale is not None:
        rig = _scaled(rig, *estimate.stereo_scale.logs.tolist())
    return replace(out, rig=rig, scale=estimate.stereo_scale)


def _scaled(rig: Rig, baseline: float, focal: float) -> Rig:
    """Return a rig whose baseline and focal lengths are longer by factors exp(baseline) and
    exp(focal), (R4); for one camera, depths are longer by both.
    """
    cam0 = _longer(rig.cam0, focal)
    if rig.cam1 is None:
        levels = rig.depth_factor
        if levels is not None:
            levels *= math.exp(-baseline - focal)
        return replace(rig, cam0=cam0, depth_factor=levels)
    cam1, T_cam1_cam0 = rig.right
    T = T_cam1_cam0.copy()
    T[:3, 3] *= math.exp(baseline)
    return replace(rig, cam0=cam0, cam1=_longer(cam1, focal), T_cam1_cam0=T)


def _longer(camera: CameraModel, focal: float) -> CameraModel:
    """Return a camera whose focal lengths are longer by a factor exp(focal).

    A pixel's ray is nearer to the axis by exp(focal), which the coefficients of the
    radial-tangential model follow, each by the power of the radius that it belongs to. Other models
    keep theirs: the same near the axis.
    """
    if focal == 0:
        return camera
    if abs(focal) > _FIT.max_log_focal:
        raise CalibrationError("focal lengths are off by more than those of any camera")
    powers = camera.lens.radius_powers(len(camera.coefficients))
    coefficients = tuple(
        c * math.exp(n * focal) for c, n in zip(camera.coefficients, powers, strict=True)
    )
    factor = math.exp(focal)
    return replace(camera, fu=factor * camera.fu, fv=factor * camera.fv, coefficients=coefficients)


def field_of(camera: StereoCamera, parameters: FloatArray) -> DisplacementField:
    """Return the field of a rectified pair, with image size, that is off by parameters (14,)."""
    given = rig_of_rectified(camera, None)
    assert given is not None
    return DisplacementField(camera, _Frame.of(given).coefficients(parameters))


def _with_field(given: Rig, field: StereoFieldEstimate) -> CalibratedRig:
    """Fit the parameters to the field's coefficients with their covariance and the prior, by
    Gauss-Newton.

    The Cauchy prior is a Gaussian one whose weights follow the parameters.
    """
    frame = _Frame.of(given)
    measured = DisplacementField.of(frame.camera, field).coefficients
    assert field.rows_covariance is not None
    P = _FIELD.model_sigma**2 * np.eye(TERMS)
    P[:FIELD_TERMS, :FIELD_TERMS] += field.covariance
    P[FIELD_TERMS:, FIELD_TERMS:] += field.rows_covariance
    P[_FOURTH, _FOURTH] += _FIELD.unknown_sigma**2
    W = np.linalg.inv(P)
    free = _expressible(given)
    x = np.zeros(len(PARAMETERS))
    J = np.zeros((TERMS, len(PARAMETERS)))
    information = np.diag(1 / _PRIOR**2)
    for round_ in range(_FIT.max_steps):
        prior = np.diag(1 / (_PRIOR**2 + x**2))
        shown = frame.coefficients(x)
        for k in np.flatnonzero(free & (round_ in _LINEARISED)):
            moved = x + _FIT.step_rad * np.eye(len(PARAMETERS))[k]
            J[:, k] = (frame.coefficients(moved) - shown) / _FIT.step_rad
        information = J.T @ W @ J + prior
        gradient = J.T @ W @ (measured - shown) - prior @ x
        step = np.linalg.solve(information, gradient * free)
        x = x + step
        if round_ > _LINEARISED[-1] and step @ information @ step < _FIT.settled_sigmas**2:
            break
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    seen = frame.as_seen(x)
    left = seen - frame.grid - error_basis(frame.camera, frame.where_read(seen)) @ measured
    left_px = float(np.sqrt(np.mean(left**2)))
    return CalibratedRig(replace(frame.moved(x), residual_px=left_px), x, covariance, left_px)


def _expressible(given: Rig) -> BoolArray:
    """Return which parameters (14,) the lens models of a rig can hold."""
    held = {
        name: all(holds_distortion(camera, *kind) for camera in given.cameras)
        for name, kind in _LENS_PARAMETERS.items()
    }
    return np.array([held.get(name, True) for name in PARAMETERS])


@dataclass(frozen=True, slots=True)
class _Frame:
    """A given rig, its rectification, and the pixels at which rigs are compared with fields."""

    given: Rig
    camera: StereoCamera
    R_rect_cam0: FloatArray  # (3, 3)
    R_rect_cam1: FloatArray  # (3, 3)
    grid: FloatArray  # (N, 4) equal left and right positions over the rectified image
    # Where the grid's left pixels (N, 2) are seen, by the true left camera: most parameters leave
    # it as it is.
    seen_left: dict[CameraModel, FloatArray] = dataclass_field(default_factory=dict)

    @classmethod
    def of(cls, rig: Rig) -> _Frame:
        """Rectify a rig."""
        camera = rig.camera
        R_rect_cam0 = np.eye(3)
        R_rect_cam1 = np.eye(3)
        if rectified_pair(rig.stereo) is None:
            pair = rectified_cameras(rig.stereo)
            camera = pair.camera
            R_rect_cam0 = pair.R_rect_cam0
            R_rect_cam1 = pair.R_rect_cam1
        assert camera.width is not None
        assert camera.height is not None
        u, v = np.meshgrid(
            np.linspace(0, camera.width - 1, _GRID[0]), np.linspace(0, camera.height - 1, _GRID[1])
        )
        return cls(
            rig, camera, R_rect_cam0, R_rect_cam1, np.stack([u, v, u, v], axis=-1).reshape(-1, 4)
        )

    def moved(self, x: FloatArray) -> Rig:
        """Return the rig whose calibration differs from the given one by parameters (14,)."""
        if not np.any(x):
            return self.given
        given = self.given
        named = dict(zip(PARAMETERS, x.tolist(), strict=True))
        k, k2, q1, q2 = (named[name] for name in _BOTH)
        longer = float(radial_focal(self.camera) @ [k, k2])
        b, T_cam1_cam0 = given.right
        b = replace(
            b,
            fu=b.fu * (1 + named["fu"]),
            fv=b.fv * (1 + named["fv"]),
            cu=b.cu + b.fu * named["cu"],
            cv=b.cv + b.fv * named["cv"],
        )
        cam0 = _bent(given.cam0, (k, k2), (q1, q2))
        cam1 = _bent(b, (k, k2), (q1 + named["p1"], q2 + named["p2"]))
        R = self.R_rect_cam1.T @ so3_exp(x[:3]) @ self.R_rect_cam0
        centre = se3_inverse(T_cam1_cam0)[:3, 3]
        down = self.R_rect_cam0[1] * named["ty"] * np.linalg.norm(centre)
        centre = (centre + down) / np.hypot(1.0, named["ty"])
        T = se3_from_parts(R, -R @ centre)
        T[:3, 3] *= math.exp(longer)
        return replace(
            given, cam0=_longer(cam0, -longer), cam1=_longer(cam1, -longer), T_cam1_cam0=T
        )

    def as_seen(self, x: FloatArray) -> FloatArray:
        """Return where the given rectification shows the grid's pixels (N, 4) if it is off by
        parameters (14,).
        """
        true = self.moved(x)
        left = self.seen_left.get(true.cam0)
        if left is None:
            left = self._seen(self.given.cam0, true.cam0, self.R_rect_cam0.T, self.R_rect_cam0)
            self.seen_left[true.cam0] = left
        cam1, T_cam1_cam0 = true.right
        turn = T_cam1_cam0[:3, :3] @ self.R_rect_cam0.T
        right = self._seen(self.given.right[0], cam1, turn, self.R_rect_cam1)
        return np.hstack([left, right])

    def _seen(
        self, believed: CameraModel, real: CameraModel, turn: FloatArray, R_rect_cam: FloatArray
    ) -> FloatArray:
        """Return where a camera shows the grid's pixels (N, 2) if it is another than believed."""
        rays = left_rays(self.camera, self.grid[:, :2])
        raw, _ = project_point(real, rays @ turn.T)
        seen, _ = rectify_pixels(believed, R_rect_cam, self.camera, raw)
        return seen

    def where_read(self, seen: FloatArray) -> FloatArray:
        """Return the pixels (N, 4) at which (R2) and (R3) are evaluated: those seen, in the rows
        of the left image.
        """
        return np.stack([seen[:, 0], seen[:, 1], seen[:, 2], self.grid[:, 3]], axis=1)

    def coefficients(self, x: FloatArray) -> FloatArray:
        """Return the field's coefficients (15,) that fit best what parameters (14,) do to the
        grid's pixels.
        """
        seen = self.as_seen(x)
        basis = error_basis(self.camera, self.where_read(seen))
        D = basis.reshape(-1, TERMS)[:, :_BELOW]
        found = np.linalg.lstsq(D, (seen - self.grid).ravel(), rcond=None)[0]
        return np.append(found, -x[PARAMETERS.index("ty")])  # shown by near points alone


def rig_off_by(given: Rig, parameters: FloatArray) -> Rig:
    """Return the rig whose calibration differs from a given one by parameters (14,)."""
    return _Frame.of(given).moved(parameters)


def _bent(
    camera: CameraModel, radial: tuple[float, float], tangential: tuple[float, float]
) -> CameraModel:
    """Return a camera with more radial and tangential distortion, as far as its model holds it."""
    model, coefficients = camera.lens.bent(camera.coefficients, radial, tangential)
    return replace(camera, model=model, coefficients=coefficients)


def estimated_rig(
    given: Rig, estimate: Estimate, camera: StereoCamera, where: str
) -> CalibratedRig:
    """Return a given rig with all that a run estimated of it.

    On a cylinder left and right stay as given: its rectification error is not expressed as a rig.

    Raises:
        CalibrationError: no rig of the given lens models is off as the run found it.
    """
    field = None if camera.is_cylinder else estimate.stereo_field
    if field is None:
        return calibrated_rig(given, replace(estimate, stereo_field=None))
    cause: CalibrationError | None = None
    try:
        found = calibrated_rig(given, estimate)
        if found.left_px <= _FIELD.max_left_px:
            return found
    except CalibrationError as error:  # the fit's steps led out of the possible rigs
        cause = error
    raise CalibrationError(
        f"{where}: no rig with the given lens models is off as the run found it (rows by "
        f"{field.rows_rms_px:.2f} px "
        "rms); the calibration may be that of other images, or without their distortion: calibrate "
        "the cameras anew"
    ) from cause
