"""Online calibration: the constants that the filter may estimate beside the motion, one class for
each block of them.

`BLOCKS` is the table: a block says when it is estimated, its prior and random walk, how an error
moves its mean, where its errors enter, and what of it is reported. A new one is a class here, its
mean in `Calibration`, its fields in `Estimate`, and its setting; its columns are in
`camera_D_error`, in `StereoCorrection`, or in the motion model's step.

A frame stamped t was exposed at `t + time_offset_s` of the IMU's clock. The extrinsics' error
`delta`, with `T_cam0_imu = T_hat exp(delta)`, is kept on the world's side,
`eta = Ad(T_world_imu) delta`, and moves with the body. Both errors enter where the camera's pose is
cloned from the body's, equations (C1) to (C5) of docs/math.md.
Reference: Li & Mourikis, Online temporal calibration for camera-IMU systems (2014).
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from vio.cameras.rectification_error import TERMS
from vio.dataclass import dataclass
from vio.filters import pose_loops as loops
from vio.filters.imu_terms import CHOSEN, IMU_TERMS, IMU_WALK, chosen_terms, term_sigmas
from vio.filters.navigation import DIM, Growth, NavState, Transition
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_inverse, so3_exp
from vio.numerics.statistics import chi_square_quantile
from vio.records import (
    FIELD_TERMS,
    IntArray,
    MotionSource,
    StereoFieldEstimate,
    StereoScaleEstimate,
)

# squared half of a twist in its standard deviations at standstill
_NOISE_ONLY = float(chi_square_quantile(0.999, 3))


class _Walks(NamedTuple):
    """Random walks of a mount that gives and of clocks that drift, each per root second."""

    extrinsic_rotation_deg: float = 2.0e-3
    extrinsic_translation_m: float = 1.0e-4
    time_offset_s: float = 2.0e-6
    # random walk of the rectification error per root second, over its initial standard deviation
    stereo_share: float = 0.02
    stereo_yaw_deg: float = 1.0e-3  # but of the right camera's rotation about its vertical axis


_WALKS = _Walks()
MIN_FIELD_SIGMA = 5.0e-4  # the same of the other rectification terms, in focal lengths
MAX_FIELD_SIGMA = 2.0e-3


class _LensPriors(NamedTuple):
    """What is known of the lenses' errors beside the rows."""

    # at least that of what both lenses have in common, which moves no rows of far points
    min_common_sigma: float = 1.0e-3
    radial_factor: float = 5.0  # a lens is left with more radial than tangential distortion


_LENSES = _LensPriors()


def stereo_field_sigmas(sigma: float, yaw_rad: float, turn_rad: float = 0.0) -> FloatArray:
    """Initial standard deviations (8,) of the rectification error, in focal lengths, by that of its
    lens terms and of the right camera's rotation about its vertical axis.

    Yaw, which moves no row, is known no better than by the turn `turn_rad` that pitch and roll
    would make of the rows.
    """
    common = max(sigma, _LENSES.min_common_sigma)
    yaw = max(yaw_rad, turn_rad)
    return np.array([yaw, *[sigma] * 3, *[_LENSES.radial_factor * common] * 2, common, common])


def stereo_yaw_rad(settings: MsckfSettings) -> float:
    """Initial standard deviation of the right camera's rotation about its vertical axis."""
    return float(np.radians(settings.stereo_yaw_sigma_deg))


@dataclass(frozen=True, slots=True)
class Twist:
    """The body twist `[v; omega]` at an exposure and how well it is known."""

    mean: FloatArray  # (6,) m/s and rad/s
    covariance: FloatArray  # (6, 6)

    def significant(self) -> FloatArray:
        """The twist (6,), each half shrunk by what its own noise may make of it, equation (C3).

        An estimated twist that is noise alone would pass for a motion, from which the time offset
        is learned.
        """
        out: FloatArray = self.mean.copy()
        loops.shrink_by_noise(self.covariance, _NOISE_ONLY, out)
        return out


_MEANS = ("T_cam0_imu", "time_offset_s", "stereo", "R_upright_world")  # of a calibration
NO_TWIST = Twist(np.zeros(6), np.zeros((6, 6)))


def body_twist(T_world_imu: FloatArray, velocity_world: FloatArray, rate: FloatArray) -> FloatArray:
    """Twist (6,) `[v; omega]` in the body frame of a pose (4, 4), a world velocity and a body
    rate (3,).
    """
    return np.concatenate([T_world_imu[:3, :3].T @ velocity_world, rate])


@dataclass(frozen=True, slots=True)
class Calibration:
    """The estimate of the rig's calibration, and which of it is estimated."""

    T_cam0_imu: FloatArray  # (4, 4)
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    # (10,) coefficients of (R3) and (R4)
    stereo: FloatArray = field(default_factory=lambda: np.zeros(TERMS))
    # (3, 3) from the world of the first seconds to that of the present estimate, which gravity
    # keeps upright
    R_upright_world: FloatArray = field(default_factory=lambda: np.eye(3))
    # names and sizes of the blocks, in the order of the table
    estimated: dict[str, int] = field(default_factory=dict)

    @property
    def moves_camera(self) -> bool:
        """Whether anything is estimated that stands between the body's pose and the camera's."""
        return _moves_camera(tuple(self.estimated))

    @property
    def stereo_terms(self) -> IntArray:
        """Which of the coefficients `stereo` are estimated."""
        return _stereo_terms(tuple(self.estimated))

    def estimating(self, name: str, settings: MsckfSettings) -> Calibration:
        """Return the calibration with one more of its blocks estimated."""
        chosen = {*self.estimated, name}
        return replace(
            self,
            estimated={key: block.size(settings) for key, block in BLOCKS.items() if key in chosen},
        )

    def corrected(self, error: FloatArray, T_world_imu: FloatArray) -> Calibration:
        """Return the calibration moved by an error (C,), the body's pose (4, 4) being that of
        the error.
        """
        means: dict[str, Any] = {name: getattr(self, name) for name in _MEANS}
        first = 0
        for name, size in self.estimated.items():
            BLOCKS[name].correct(means, error[first : first + size], T_world_imu)
            first += size
        return Calibration(**means, estimated=self.estimated)

    def variances(self, of_block: dict[str, FloatArray]) -> FloatArray:
        """Join variances, given by block, of the blocks that are estimated (C,)."""
        return np.concatenate([np.zeros(0), *(of_block[name] for name in self.estimated)])

    def in_world(self, variances: FloatArray, T_world_imu: FloatArray) -> FloatArray:
        """Turn variances (C,) of the constants into the covariance (C, C) of their errors, with
        eta.
        """
        out = np.diag(variances)
        first = 0
        for name, size in self.estimated.items():
            block = BLOCKS[name]
            if block.is_in_world:
                moved = block.moved_by(T_world_imu)
                own = slice(first, first + size)
                out[own, own] = moved @ out[own, own] @ moved.T
            first += size
        return out

    def transition(
        self, state: OwnRows, step: Transition | Growth, T_after: FloatArray, T_before: FloatArray
    ) -> FloatArray:
        """Transition (15 + C, 15 + C) of the errors of navigation state and calibration, equation
        (C4).

        Args:
            state: their rows.
            step: of the navigation state.
            T_after: (4, 4) the body's pose behind it.
            T_before: likewise before it.
        """
        out = state.own_identity.copy()
        out[:DIM, :DIM] = step.Phi
        if step.Phi_imu is not None:
            out[:DIM, state.blocks["imu_terms"]] = step.Phi_imu
        for name in self.estimated:
            block = BLOCKS[name]
            if block.is_in_world:
                moved = block.moved_by(T_after @ se3_inverse(T_before))
                out[state.blocks[name], state.blocks[name]] = moved
        return out

    def report(self, state: OwnRows, nav: NavState, covariance: FloatArray) -> dict[str, Any]:
        """Return the fields of `Estimate` that say what is estimated, by the errors' covariance
        (15 + C, 15 + C).
        """
        out: dict[str, Any] = {}
        for name in self.estimated:
            rows = state.blocks[name]
            out |= BLOCKS[name].report(self, nav, covariance[rows, rows])
        return out


@lru_cache(maxsize=8)
def _stereo_terms(names: tuple[str, ...]) -> IntArray:
    """Which of the coefficients `Calibration.stereo` are estimated with the blocks of given
    names.
    """
    blocks = [BLOCKS[name] for name in names]
    terms = [np.arange(TERMS)[block.terms] for block in blocks if isinstance(block, StereoBlock)]
    return np.concatenate([np.arange(0), *terms])


@lru_cache(maxsize=8)
def _moves_camera(names: tuple[str, ...]) -> bool:
    """Whether one of the blocks of given names enters in the camera's pose."""
    return any(BLOCKS[name].enters == "camera" for name in names)


class OwnRows(Protocol):
    """Rows of an error vector, as far as the calibration needs them: see `ErrorState`."""

    own: slice  # of navigation state and calibration
    own_identity: FloatArray  # (15 + C, 15 + C) the identity, not to be changed
    blocks: dict[str, slice]  # rows of each, by name


class CalibrationBlock:
    """Constants that are estimated together: one line of the table."""

    name: ClassVar[str]
    # Where its errors enter: in the motion model's step, in pixels, or in the camera's pose at an
    # exposure.
    enters: ClassVar[Literal["motion", "pixels", "camera"]]
    walk: ClassVar[float] = 0.0  # random walk per root second, over the initial standard deviation
    # Whether its errors are kept on the world's side, and so follow the body's motions.
    is_in_world: ClassVar[bool] = False

    def size(self, settings: MsckfSettings) -> int:
        """How many errors (n) it has."""
        return len(self.sigmas(settings))

    def is_estimated(self, settings: MsckfSettings, motion: MotionSource | None) -> bool:
        """Whether it is estimated from the start, with given motion samples."""
        return False

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        """Initial standard deviations (n,)."""
        raise NotImplementedError

    def walks(self, settings: MsckfSettings) -> FloatArray:
        """Random walks (n,), standard deviations per root second."""
        return self.sigmas(settings) * self.walk

    def correct(self, means: dict[str, Any], error: FloatArray, T_world_imu: FloatArray) -> None:
        """Move the means of a calibration, by field, by an error (n,) at a pose of the body (4, 4):
        replace those that it moves.
        """

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        """Return the fields of `Estimate` with mean and uncertainty, by the covariance (n, n) of
        the errors.
        """
        return {}

    def moved_by(self, T: FloatArray) -> FloatArray:
        """How its errors follow a motion (4, 4) of the body on the world's side (n, n), where they
        are kept there.
        """
        raise NotImplementedError

    def camera_D_error(
        self, T_world_imu: FloatArray, T_exposed: FloatArray, twist: Twist | None
    ) -> FloatArray | None:
        """How its errors move the camera at an exposure (6, n), equation (C2); None: not.

        Args:
            T_world_imu: the navigation state's pose (4, 4).
            T_exposed: the body's at the exposure (4, 4).
            twist: of the body; None while exposures do not follow the time offset's error.
        """
        return None


class _ImuTermsBlock(CalibrationBlock):
    """Scale and misalignment of the IMU; the navigation state has their means, and its motion
    model their columns.
    """

    name = "imu_terms"
    enters = "motion"
    walk = IMU_WALK

    def is_estimated(self, settings: MsckfSettings, motion: MotionSource | None) -> bool:
        return motion == "imu" and settings.calibrate_imu != "off"

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        return term_sigmas()[chosen_terms(settings)]

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        sigmas = np.zeros(IMU_TERMS)
        sigmas[_estimated_terms(len(covariance))] = np.sqrt(covariance.diagonal())
        return {"imu_terms": nav.imu_terms, "imu_terms_sigma": sigmas}


class StereoBlock(CalibrationBlock):
    """Some coefficients of the stereo calibration; `StereoCorrection` has their columns in the
    pixels.
    """

    terms: ClassVar[slice]  # of `Calibration.stereo`
    enters = "pixels"
    walk = _WALKS.stereo_share

    def correct(self, means: dict[str, Any], error: FloatArray, T_world_imu: FloatArray) -> None:
        """Move the coefficients of the block."""
        stereo = means["stereo"].copy()
        stereo[self.terms] += error
        means["stereo"] = stereo


class _StereoFieldBlock(StereoBlock):
    """The field of right columns, equation (R3); its estimation begins with the first rows,
    which give its prior.
    """

    name = "stereo_field"
    terms = slice(0, FIELD_TERMS)

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        return stereo_field_sigmas(MAX_FIELD_SIGMA, stereo_yaw_rad(settings))

    def walks(self, settings: MsckfSettings) -> FloatArray:
        # How well a calibration is known says nothing of how fast a mount gives.
        yaw_rad = float(np.radians(_WALKS.stereo_yaw_deg))
        return np.append(yaw_rad, super().walks(settings)[1:])

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        return {"stereo_field": StereoFieldEstimate(calibration.stereo[self.terms], covariance)}


class _StereoScaleBlock(StereoBlock):
    """Baseline and focal length, equation (R4); they are estimated with a metric sensor only."""

    name = "stereo_scale"
    terms = slice(FIELD_TERMS, TERMS)

    def is_estimated(self, settings: MsckfSettings, motion: MotionSource | None) -> bool:
        return motion is not None and settings.calibrate_scale == "on"

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        return np.array([settings.stereo_baseline_sigma, settings.stereo_focal_sigma])

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        return {"stereo_scale": StereoScaleEstimate(calibration.stereo[self.terms], covariance)}


class _ExtrinsicsBlock(CalibrationBlock):
    """How the camera sits on the IMU; its error is kept on the world's side."""

    name = "extrinsics"
    enters = "camera"
    is_in_world = True

    def is_estimated(self, settings: MsckfSettings, motion: MotionSource | None) -> bool:
        return motion == "imu" and settings.calibrate_camera_imu in ("extrinsics", "both")

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        rotation = np.radians(settings.extrinsic_rotation_sigma_deg)
        return np.repeat([settings.extrinsic_translation_sigma_m, rotation], 3)

    def walks(self, settings: MsckfSettings) -> FloatArray:
        return np.repeat(
            [_WALKS.extrinsic_translation_m, np.radians(_WALKS.extrinsic_rotation_deg)], 3
        )

    def correct(self, means: dict[str, Any], error: FloatArray, T_world_imu: FloatArray) -> None:
        moved = se3_exp(se3_adjoint(se3_inverse(T_world_imu)) @ error)
        means["T_cam0_imu"] = means["T_cam0_imu"] @ moved

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        back = se3_adjoint(se3_inverse(nav.T_world_imu))
        return {
            "T_cam0_imu": calibration.T_cam0_imu,
            "T_cam0_imu_covariance": back @ covariance @ back.T,
        }

    def moved_by(self, T: FloatArray) -> FloatArray:
        return se3_adjoint(T)

    def camera_D_error(
        self, T_world_imu: FloatArray, T_exposed: FloatArray, twist: Twist | None
    ) -> FloatArray | None:
        return -se3_adjoint(T_exposed @ se3_inverse(T_world_imu))


class _TimeOffsetBlock(CalibrationBlock):
    """How the clocks of camera and IMU differ."""

    name = "time_offset"
    enters = "camera"

    def is_estimated(self, settings: MsckfSettings, motion: MotionSource | None) -> bool:
        return motion == "imu" and settings.calibrate_camera_imu in ("auto", "time_offset", "both")

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        return np.array([settings.time_offset_sigma_s])

    def walks(self, settings: MsckfSettings) -> FloatArray:
        return np.array([_WALKS.time_offset_s])

    def correct(self, means: dict[str, Any], error: FloatArray, T_world_imu: FloatArray) -> None:
        means["time_offset_s"] += float(error[0])

    def report(
        self, calibration: Calibration, nav: NavState, covariance: FloatArray
    ) -> dict[str, Any]:
        sigma = float(np.sqrt(covariance[0, 0]))
        return {"time_offset_s": calibration.time_offset_s, "time_offset_sigma_s": sigma}

    def camera_D_error(
        self, T_world_imu: FloatArray, T_exposed: FloatArray, twist: Twist | None
    ) -> FloatArray | None:
        if twist is None:
            return None
        return (se3_adjoint(T_exposed) @ twist.significant())[:, None]


class _FirstAttitudeBlock(CalibrationBlock):
    """The attitude of the first frame, which defines the world that is reported, after it has
    left the window.
    """

    name = "first_attitude"
    enters = "camera"  # behind all others; nothing depends on it

    def sigmas(self, settings: MsckfSettings) -> FloatArray:
        return np.zeros(3)

    def correct(self, means: dict[str, Any], error: FloatArray, T_world_imu: FloatArray) -> None:
        means["R_upright_world"] = so3_exp(error) @ means["R_upright_world"]


_ALL = (
    _ImuTermsBlock(),
    _StereoFieldBlock(),
    _StereoScaleBlock(),
    _ExtrinsicsBlock(),
    _TimeOffsetBlock(),
    _FirstAttitudeBlock(),
)
# In the order of the error vector: what enters in the motion, in pixels, in the camera's pose.
BLOCKS: dict[str, CalibrationBlock] = {block.name: block for block in _ALL}


def first_calibration(
    T_cam0_imu: FloatArray, settings: MsckfSettings, motion: MotionSource | None
) -> Calibration:
    """Return the calibration at the start.

    Of camera and IMU nothing is estimated without an IMU, and nothing metric without a metric
    sensor.
    """
    sizes = {
        name: block.size(settings)
        for name, block in BLOCKS.items()
        if block.is_estimated(settings, motion)
    }
    return Calibration(np.asarray(T_cam0_imu, dtype=np.float64), estimated=sizes)


def prior_variances(settings: MsckfSettings) -> dict[str, FloatArray]:
    """Return the initial variances (n,) of every block."""
    return {name: block.sigmas(settings) ** 2 for name, block in BLOCKS.items()}


def walk_variances(settings: MsckfSettings) -> dict[str, FloatArray]:
    """Return the variances (n,) that a second of random walk adds to every block."""
    return {name: block.walks(settings) ** 2 for name, block in BLOCKS.items()}


def all_imu_terms(covariance: FloatArray) -> FloatArray:
    """Fill a covariance (I, I) of the IMU's terms that are estimated up to all (15, 15), with
    zeros.
    """
    out = np.zeros((IMU_TERMS, IMU_TERMS))
    chosen = _estimated_terms(len(covariance))
    out[chosen[:, None], chosen] = covariance
    return out


@lru_cache(maxsize=8)
def _estimated_terms(count: int) -> IntArray:
    """Which of the IMU's terms are estimated, by how many."""
    return next(rows for rows in CHOSEN.values() if len(rows) == count)
