"""The records that travel between the parts: plain frozen data, no behaviour beyond slicing.

Frames, units and pixel conventions are those of docs/conventions.md. Images are uint8 (H, W); ids
int64; everything else float64. Missing is `None` or a mask, never a special number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.findings import Finding, Integrity
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity, Tolerance

NS_PER_S = 10**9
MAX_GYRO_BIAS_RADPS = 0.5  # no sensor that works has more
S_PER_NS = 1.0 / NS_PER_S  # products with it and quotients by NS_PER_S differ in the last bit
Image: TypeAlias = npt.NDArray[np.uint8]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
SigmaArray: TypeAlias = npt.NDArray[np.float32]  # standard deviations
BodyFrame: TypeAlias = Literal["imu", "cam0"]
# How a trajectory's orientations are known: its file states the order of the quaternions' numbers,
# or it was assumed that w is the first of them, or the last; or there are none, and its rotations
# are the identity.
Orientations: TypeAlias = Literal["stated", "w first, assumed", "w last, assumed", "none"]
MotionSource: TypeAlias = Literal["imu", "velocity"]
RunMotion: TypeAlias = Literal["imu", "velocity", "none"]  # none: images alone


_ID_SPAN: Capacity[int] = 32  # ids between the first and the last of a frame, for each feature


class _RotationRules(NamedTuple):
    """When gyro and camera rotate at different rates."""

    # Rigs are calibrated to 1 % of a focal length, and gyros to 1 or 2 % of their scale.
    min_difference: float = 0.03
    min_sigmas: float = 5.0
    calibration_sigma: float = 0.01


_ROTATION = _RotationRules()
_KNOWN: Tolerance[float] = 1e-8  # a standard deviation below it is rounding
_INT64 = np.dtype(np.int64)
_FLOAT64 = np.dtype(np.float64)
_FLOAT32 = np.dtype(np.float32)
_BOOL = np.dtype(np.bool_)


def _type_text(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    return f"a {type(value).__name__}"


def _is_vector(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.shape == (3,) and value.dtype == _FLOAT64


def _check_sample(name: str, time_ns: object, **vectors: object) -> None:
    if not isinstance(time_ns, (int, np.integer)):
        raise DataError(f"{name}: time_ns is {_type_text(time_ns)}, not whole nanoseconds")
    for key, value in vectors.items():
        if not _is_vector(value):
            raise DataError(
                f"{name}: {key} is {_type_text(value)}, not an array (3,) of float64; use "
                "numpy.array(…, float)"
            )


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One raw reading of an inertial measurement unit."""

    time_ns: int
    gyro: FloatArray  # (3,) rad/s, imu frame
    accel: FloatArray  # (3,) m/s^2, imu frame, specific force (about +9.81 up at rest)

    def __post_init__(self) -> None:
        """Raise DataError unless the types are those above; the filters check the values."""
        gyro = self.gyro
        accel = self.accel
        if (  # written out, as it is asked of every sample
            type(self.time_ns) is int
            and type(gyro) is np.ndarray
            and type(accel) is np.ndarray
            and gyro.shape == accel.shape == (3,)
            and gyro.dtype is _FLOAT64
            and accel.dtype is _FLOAT64
        ):
            return
        _check_sample("ImuSample", self.time_ns, gyro=gyro, accel=accel)


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """Raw readings of an inertial measurement unit, with the true biases where they are known."""

    times_ns: IntArray  # (N,) strictly increasing
    gyro: FloatArray  # (N, 3) rad/s, imu frame
    accel: FloatArray  # (N, 3) m/s^2, imu frame, specific force
    gyro_bias: FloatArray | None = None  # (N, 3) rad/s; None for a real record
    accel_bias: FloatArray | None = None  # (N, 3) m/s^2; None for a real record


@dataclass(frozen=True, slots=True)
class ImuDensities:
    """Noise of an inertial measurement unit as its calibration states it (continuous time)."""

    gyro: float  # white noise, rad/s/sqrt(Hz)
    gyro_walk: float  # bias random walk, rad/s^2/sqrt(Hz)
    accel: float  # white noise, m/s^2/sqrt(Hz)
    accel_walk: float  # bias random walk, m/s^3/sqrt(Hz)


@dataclass(frozen=True, slots=True)
class VelocitySample:
    """The paper's control input `u = [v; omega]`: body velocity and angular rate."""

    time_ns: int
    linear: FloatArray  # (3,) m/s, imu frame
    angular: FloatArray  # (3,) rad/s, imu frame

    def __post_init__(self) -> None:
        """Raise DataError unless the types are those above; the filters check the values."""
        _check_sample("VelocitySample", self.time_ns, linear=self.linear, angular=self.angular)


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One exposure of a stereo pair, of one camera, or of one camera with depths.

    The images are None where the recording holds features only, or none were asked for.
    """

    index: int  # frame number in the recording, from 0, whatever --start says
    time_ns: int
    left: Image | None  # (H, W) rectified
    right: Image | None  # (H, W) rectified; None for one camera
    # (H, W) metres along the optical axis, 0 where unknown; with depth images only
    depth: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class CheckedFrame(StereoFrame):
    """A frame as the guards hand it to a front end."""

    left_half: Image | None = None  # (H/2, W/2) the left image at half resolution
    right_half: Image | None = None  # likewise
    # False: the right image is frozen, dark or covered; no match in it counts
    right_usable: bool = True
    right_delay: int = 0  # frames by which the right image is known to be late
    # the pairs so far were wrong: depths of features that were seen in them do not count
    begin_again: bool = False


MotionSample: TypeAlias = ImuSample | VelocitySample
Event: TypeAlias = ImuSample | VelocitySample | StereoFrame


@dataclass(frozen=True, slots=True)
class Observations:
    """What one stereo frame shows of the tracked features."""

    frame_index: int
    time_ns: int
    # (N,) unique within the frame; an id names one feature for ever and is never reused
    ids: IntArray
    # (N, 4) rectified pixels [ul vl ur vr]; ur, vr are arbitrary where has_right is False
    z: FloatArray
    has_right: BoolArray  # (N,) False: seen in the left image only
    # (N,) True: the pixels are known to be old (repeated by the source) and must not be trusted
    stale: BoolArray
    # (N, 3) of [ul vl ur], px, relative to one another; 0: not known; None: all alike
    sigma: SigmaArray | None = None

    def __post_init__(self) -> None:
        """Raise DataError unless types and lengths are those above; the filters check the
        values.
        """
        if not self._has_usual_types():
            self._check()

    def _has_usual_types(self) -> bool:
        """Whether the types are exactly those above, as of nearly all: they are asked often."""
        ids = self.ids
        z = self.z
        sigma = self.sigma
        for value in (ids, z, self.has_right, self.stale):
            if type(value) is not np.ndarray:
                return False
        if ids.ndim != 1 or type(self.time_ns) is not int:
            return False
        if sigma is not None and (sigma.dtype is not _FLOAT32 or sigma.shape != (*ids.shape, 3)):
            return False
        return (
            ids.dtype is _INT64
            and z.dtype is _FLOAT64
            and self.has_right.dtype is self.stale.dtype is _BOOL
            and z.shape == (*ids.shape, 4)
            and self.has_right.shape == self.stale.shape == ids.shape
        )

    def _check(self) -> None:
        shape = getattr(self.ids, "shape", None)
        for name, value, dtype, expected in (
            ("ids", self.ids, _INT64, shape if shape is not None and len(shape) == 1 else ("N",)),
            ("z", self.z, _FLOAT64, (*shape, 4) if shape is not None else ("N", 4)),
            ("has_right", self.has_right, _BOOL, shape),
            ("stale", self.stale, _BOOL, shape),
        ):
            if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != expected:
                raise DataError(
                    f"Observations of frame {self.frame_index}: {name} is {_type_text(value)}, not "
                    f"an array {expected} "
                    f"of {dtype}; vio.records.observations builds them from lists"
                )
        sigma = self.sigma
        if sigma is not None and (sigma.dtype != np.float32 or sigma.shape != (len(self.ids), 3)):
            raise DataError(
                f"Observations of frame {self.frame_index}: sigma is {_type_text(sigma)}, not (N, "
                "3) of float32"
            )
        if not isinstance(self.time_ns, (int, np.integer)):
            raise DataError(
                f"Observations: time_ns is {_type_text(self.time_ns)}, not whole nanoseconds"
            )

    def __len__(self) -> int:
        return self.ids.size

    def take(self, index: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Observations:
        """Return the rows named by a mask (N,) or by indices (K,); the record itself where a
        mask names all.
        """
        if index.dtype == np.bool_ and index.all():
            return self
        ids = self.ids[index]
        z = self.z[index]
        has_right = self.has_right[index]
        stale = self.stale[index]
        sigma = None if self.sigma is None else self.sigma[index]
        return Observations(self.frame_index, self.time_ns, ids, z, has_right, stale, sigma)


def shared_rows(ids: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows (K,) of the features that two frames share, in the one and in the other, in
    the order of their ids; the ids (N,) and (M,) of a frame are unique.
    """
    ids = np.ascontiguousarray(ids, dtype=np.int64)  # others would be compiled for anew
    other = np.ascontiguousarray(other, dtype=np.int64)
    rows = np.empty(min(ids.size, other.size), dtype=np.int64)
    others = np.empty_like(rows)
    count = _meet(ids, other, rows, others)
    if count >= 0:
        return rows[:count], others[:count]
    rows = ids.argsort()
    others = other.argsort()
    place = other[others].searchsorted(ids[rows])
    inside = place < others.size
    rows = rows[inside]
    others = others[place[inside]]
    same = ids[rows] == other[others]
    return rows[same], others[same]


@compiled
def _meet(ids: IntArray, other: IntArray, rows: IntArray, others: IntArray) -> int:
    """Write where ids (N,) and (M,) are the same, in their order, and return how often; -1: they
    are too far apart for a table of all between them.
    """
    if not len(rows):
        return 0
    first = max(ids.min(), other.min())
    last = min(ids.max(), other.max())
    if last < first:
        return 0
    if float(last) - float(first) >= _ID_SPAN * (len(ids) + len(other)):  # whole ones overflow
        return -1
    span = last - first + 1
    places = np.empty((2, span), np.int64)
    _look_up(ids, first, places[0])
    _look_up(other, first, places[1])
    count = 0
    for k in range(span):
        if places[0, k] >= 0 and places[1, k] >= 0:
            rows[count] = places[0, k]
            others[count] = places[1, k]
            count += 1
    return count


@compiled
def _look_up(ids: IntArray, first: int, place: IntArray) -> None:
    """Write where ids (N,) have each of the numbers (S,) from the first one on; -1: nowhere."""
    last = first + len(place) - 1
    for k in range(len(place)):
        place[k] = -1
    for k in range(len(ids)):
        if first <= ids[k] <= last:
            place[ids[k] - first] = k


def observations(
    frame_index: int,
    time_ns: int,
    ids: npt.ArrayLike,
    z: npt.ArrayLike,
    has_right: npt.ArrayLike | None = None,
    stale: npt.ArrayLike | None = None,
) -> Observations:
    """Build `Observations` from array-likes; without masks, every row is a fresh stereo
    observation.

    Raises:
        DataError: shapes disagree, an id occurs twice, or a value is no number.
    """
    try:
        given = np.asarray(ids).reshape(-1)
        if given.size and given.dtype.kind not in "iu":
            raise DataError(f"frame {frame_index}: ids are whole numbers, got {given.dtype}")
        ids_ = given.astype(np.int64)
        n = given.size
        pixels = np.asarray(z, dtype=np.float64)
        if pixels.ndim == 2 and pixels.size and pixels.shape[1] != 4:
            raise DataError(
                f"frame {frame_index}: z has the shape {pixels.shape}; give (N, 4), "
                "[ul vl ur vr] of each id in a row"
            )
        z_ = pixels.reshape(-1, 4)
        right = (
            np.ones(n, dtype=np.bool_)
            if has_right is None
            else np.asarray(has_right, dtype=np.bool_)
        )
        if stale is None:
            old = np.zeros(n, dtype=np.bool_)
        else:
            old = np.asarray(stale, dtype=np.bool_)
        index = int(frame_index)
        stamp_ns = int(time_ns)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(
            f"frame {frame_index}: no observations can be made of this ({error})"
        ) from error
    if not (len(z_) == n and right.shape == (n,) and old.shape == (n,)):
        raise DataError(
            f"observations disagree in length: {n} ids, {len(z_)} z, {right.shape}, {old.shape} "
            "masks"
        )
    if len(np.unique(ids_)) != n:
        raise DataError(f"frame {frame_index}: an id occurs twice among {n} observations")
    return Observations(index, stamp_ns, ids_, z_, right, old)


@dataclass(frozen=True, slots=True)
class FeatureTracks:
    """The observations of all frames of a recording as one table, ordered by frame."""

    offsets: IntArray  # (F + 1,) the rows of frame k are offsets[k]:offsets[k + 1]
    ids: IntArray  # (R,)
    z: FloatArray  # (R, 4) rectified pixels [ul vl ur vr]
    has_right: BoolArray  # (R,) as in `Observations`
    stale: BoolArray  # (R,) likewise
    sigma: SigmaArray | None = None  # (R, 3) likewise

    @property
    def frames(self) -> IntArray:
        """Frame number (R,) of each row."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    def at(self, frame: int, time_ns: int) -> Observations:
        """The observations of one frame."""
        rows = slice(self.offsets[frame], self.offsets[frame + 1])
        sigma = None if self.sigma is None else self.sigma[rows]
        columns = self.ids[rows], self.z[rows], self.has_right[rows], self.stale[rows]
        return Observations(frame, time_ns, *columns, sigma)


def feature_tracks(seen: Mapping[int, Observations], frames: int) -> FeatureTracks:
    """Join the observations of some of `frames` frames, named by their numbers; the others show
    nothing.
    """
    counts = np.zeros(frames + 1, dtype=np.int64)
    for k, shown in seen.items():
        counts[k + 1] = len(shown)
    parts = [seen[k] for k in sorted(seen)]
    no_ids = np.zeros(0, dtype=np.int64)
    no_pixels = np.zeros((0, 4))
    no_marks = np.zeros(0, dtype=np.bool_)
    return FeatureTracks(
        np.cumsum(counts),
        np.concatenate([no_ids, *(o.ids for o in parts)]),
        np.concatenate([no_pixels, *(o.z for o in parts)]),
        np.concatenate([no_marks, *(o.has_right for o in parts)]),
        np.concatenate([no_marks, *(o.stale for o in parts)]),
        joined_sigmas(parts),
    )


def joined_sigmas(parts: Sequence[Observations]) -> SigmaArray | None:
    """The standard deviations (R, 3) of all rows of some frames; None where no frame has any."""
    if all(o.sigma is None for o in parts):
        return None
    return np.concatenate(
        [np.zeros((len(o), 3), np.float32) if o.sigma is None else o.sigma for o in parts]
    )


@dataclass(frozen=True, slots=True)
class TrackPrior:
    """What the filter expects of the next frame, offered to the front end as an initial guess."""

    ids: IntArray  # (N,)
    z: FloatArray  # (N, 4) predicted pixels
    # (3, 3) rotation that maps the previous cam0 frame into the coming one
    R_cam_prev: FloatArray | None = None
    # the whole motion since the previous frame, with its covariance
    motion: MotionPrior | None = None

    @property
    def measured_motion(self) -> MotionPrior | None:
        """The motion, if a sensor has measured it."""
        if self.motion is not None and self.motion.measured:
            return self.motion
        return None


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """What the back end expects of the left camera's motion from the last frame to the coming
    one.
    """

    T_curr_prev: FloatArray  # (4, 4) maps the previous cam0 frame into the coming one
    covariance: FloatArray  # (6, 6) of xi in T_curr_prev = exp(xi) T_hat, [rho; phi], m and rad
    measured: bool = True  # by a motion sensor; False: the rig is expected to go on as before


@dataclass(frozen=True, slots=True)
class Prediction:
    """What the back end expects of the coming frame before it has seen it."""

    tracks: TrackPrior
    motion: MotionPrior


@dataclass(frozen=True, slots=True)
class FrontendOutput:
    """The observations of one frame and what it took to get them; the counts are for logs alone."""

    observations: Observations
    tracked: int = 0  # features carried over from the frame before, after all checks
    matched: int = 0  # features with a right match
    detected: int = 0  # features new in this frame
    stages_ms: dict[str, float] = field(default_factory=dict)  # wall time per stage
    warnings: tuple[str, ...] = ()  # remarks of a front end of one's own, one line an event
    findings: tuple[Finding, ...] = ()  # what is wrong with the images


def no_features(frame: StereoFrame) -> FrontendOutput:
    """Return the output for a frame whose images are not used."""
    return FrontendOutput(observations(frame.index, frame.time_ns, [], np.zeros((0, 4))), 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which observations enter the update, and why."""

    chosen: BoolArray  # (N,)
    score: FloatArray  # (N,) the quantity that was ranked; larger is better
    reason: str  # one line for the log


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Points of the map."""

    ids: IntArray  # (M,)
    p_world: FloatArray  # (M, 3) metres
    covariance: FloatArray  # (M, 3, 3) m^2


def no_landmarks() -> Landmarks:
    """Return a map without points."""
    return Landmarks(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


# coefficients of a rectification error: a0 to a3 of the right columns, equation (R3) of
# docs/math.md
RIGHT_TERMS = 4
FIELD_TERMS = 8  # those, and k1, k2, q1, q2 of both lenses
ROW_TERMS = 7  # coefficients of the right rows, equation (R2)


@dataclass(frozen=True, slots=True)
class StereoFieldEstimate:
    """What the stereo calibration is off by, as coefficients of equations (R2) and (R3) of
    docs/math.md.

    All are in focal lengths.
    """

    # (8,) a0, a1, a2, a3 of the right columns; k1, k2, q1, q2 of both lenses
    coefficients: FloatArray
    covariance: FloatArray  # (8, 8)
    # root mean square over the features of what the rows of left and right differ by
    rows_rms_px: float = 0.0
    # (7,) of 1, x, y, x y, x^2, y^2, d in the right rows (R2); None: not learned
    rows: FloatArray | None = None
    rows_covariance: FloatArray | None = None  # (7, 7)


@dataclass(frozen=True, slots=True)
class RotationComparison:
    """How the camera's rotation about the axes of its image compares with the gyro's; (I5) of
    docs/inertial.md.
    """

    excess: float  # by what share the camera rotates more than the gyro measures
    sigma: float  # its standard deviation; inf: there is no rotation
    # about the optical axis, where no focal length matters: the gyro's scale is not the cause
    gyro_agrees: bool

    @property
    def differ(self) -> bool:
        """Whether they differ beyond doubt, and beyond what calibrations leave."""
        return self.sigma < _ROTATION.calibration_sigma and abs(self.excess) > max(
            _ROTATION.min_difference, _ROTATION.min_sigmas * self.sigma
        )

    @property
    def agree(self) -> bool:
        """Whether no focal length that is off shows in them, be it that there are none."""
        return self.sigma == np.inf or (
            self.sigma < 2 * _ROTATION.calibration_sigma
            and abs(self.excess) < _ROTATION.min_difference
        )


ROTATION_NOT_COMPARABLE = RotationComparison(0.0, np.inf, False)


@dataclass(frozen=True, slots=True)
class StereoScaleEstimate:
    """By what baseline and focal length differ from the calibration, equation (R4) of
    docs/math.md.
    """

    # (2,) of baseline over calibrated baseline, focal length over calibrated focal length
    logs: FloatArray
    covariance: FloatArray  # (2, 2); zero for the baseline where it counts as known

    def percent(self) -> dict[str, tuple[float, float]]:
        """What differs by how much from the calibration and its standard deviation, %, of what
        is estimated.
        """
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {
            name: (100 * float(np.expm1(log)), 100 * float(sigma))
            for name, log, sigma in zip(
                ("baseline", "focal length"), self.logs, sigmas, strict=True
            )
            if sigma > _KNOWN
        }


# Entries (sensor, row, column) of the matrices of equation (A1) that are terms: accelerometer, then
# gyro.
_UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
IMU_ENTRIES = (
    *((0, *at) for at in _UPPER),
    *((1, *at) for at in (*_UPPER, (1, 0), (2, 0), (2, 1))),
)
_SENSORS, _ROWS, _COLUMNS = np.array(IMU_ENTRIES).T
_IDENTITIES = np.tile(np.eye(3), (2, 1, 1))


def imu_matrices(terms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `M_a` and `M_g` (3, 3) of equation (A1), which take readings to truth plus bias,
    from 15 terms.
    """
    M = _IDENTITIES.copy()
    M[_SENSORS, _ROWS, _COLUMNS] += terms
    return M[0], M[1]


def _kept(*shape: int) -> dict[str, tuple[int, ...]]:
    """Metadata of a field that may be missing, and that a run keeps as an array of a shape, ()
    for a number.
    """
    return {"shape": shape}


@dataclass(frozen=True, slots=True)
class Estimate:
    """The filter's belief at one time."""

    time_ns: int
    T_world_imu: FloatArray  # (4, 4)
    # (6, 6) of xi in T_imu_world = exp(xi) T_imu_world_hat, [rho; phi], m and rad
    covariance: FloatArray
    velocity_world: FloatArray | None = field(default=None, metadata=_kept(3))  # m/s
    # of velocity_world, (m/s)^2
    velocity_covariance: FloatArray | None = field(default=None, metadata=_kept(3, 3))
    gyro_bias: FloatArray | None = field(default=None, metadata=_kept(3))  # rad/s
    # standard deviations, rad/s
    gyro_bias_sigma: FloatArray | None = field(default=None, metadata=_kept(3))
    accel_bias: FloatArray | None = field(default=None, metadata=_kept(3))  # m/s^2
    # Standard deviations, m/s^2; zero where it is not estimated.
    accel_bias_sigma: FloatArray | None = field(default=None, metadata=_kept(3))
    # m/s^2, where the world is not that of the vertical known at present: it stays that of the
    # first seconds, or of the images before an IMU that began late. None: along -z.
    gravity_world: FloatArray | None = field(default=None, metadata=_kept(3))
    # Standard deviation of the vertical seen from the body, rad, each horizontal axis; None: no IMU
    # has shown it.
    tilt_sigma_rad: float | None = field(default=None, metadata=_kept())
    # The calibration, where the filter estimates it.
    T_cam0_imu: FloatArray | None = field(default=None, metadata=_kept(4, 4))
    # Of xi in T_cam0_imu = T_hat exp(xi), [rho; phi], m and rad.
    T_cam0_imu_covariance: FloatArray | None = field(default=None, metadata=_kept(6, 6))
    # Scale and misalignment of accelerometer and gyro, as IMU_ENTRIES; standard deviations, zero
    # where not estimated.
    imu_terms: FloatArray | None = field(default=None, metadata=_kept(15))
    imu_terms_sigma: FloatArray | None = field(default=None, metadata=_kept(15))
    # A frame stamped t was exposed at t + offset of the IMU's clock.
    time_offset_s: float | None = field(default=None, metadata=_kept())
    time_offset_sigma_s: float | None = field(default=None, metadata=_kept())
    stereo_field: StereoFieldEstimate | None = None
    stereo_scale: StereoScaleEstimate | None = None
    # One camera: standard deviation of the scale of the last frames' motion, over it.
    scale_sigma: float | None = field(default=None, metadata=_kept())
    # The pose in a map; None without one, or without a place in it yet.
    T_map_body: FloatArray | None = None  # (4, 4)
    T_map_body_covariance: FloatArray | None = None  # (6, 6) of xi in T_map_body = T_hat exp(xi)
    # Whether it may be used, by all that was found; the covariance alone is conditional on what the
    # filter assumes.
    integrity: Integrity = "nominal"
    findings: tuple[str, ...] = ()  # codes of what makes it other than nominal
    # standard deviation that findings add to the position, m, each axis: in the covariance already
    position_doubt_m: float = field(default=0.0, metadata=_kept())


def _no_ids() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Initialisation:
    """How a back end's state was initialised, or what it waits for."""

    waits_for: str | None = None  # what is not observable yet; None: the state is initialised
    # standard deviation of the scale over it; None: at standstill, or it is known
    scale_sigma: float | None = None


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What one filter update did."""

    used: int  # observations that moved the state
    gated: int  # observations rejected by the chi-square gate
    initialised: int  # landmarks created
    landmarks: int  # landmarks in the map
    # median absolute innovation before the update, all gated-in rows
    innovation_median_px: float | None
    # normalised innovation squared over its degrees of freedom; about 1 when consistent
    nis_per_dof: float | None
    # of those rejected, where the back end says it
    gated_ids: IntArray = field(default_factory=_no_ids, compare=False)
    # of the landmarks in the map, likewise
    landmark_ids: IntArray = field(default_factory=_no_ids, compare=False)
    # median innovation over its standard deviation; about 1 when consistent
    innovation_ratio: float | None = None
    started: bool = True  # False: nothing can be estimated yet, and the frame has no pose
    # by which the gyro's bias has jumped, rad/s, as the images show; None: it has not
    gyro_jump_radps: float | None = None
    # by what the scale may be off, over it, as the motion sensor suggests, beside what is
    # considered
    scale_doubt: float = 0.0
    # variance of the tracks' pixels in this frame, less what other poses explain, over the one
    # learned before; 1 when consistent
    misfit: float = 1.0


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time of one named frame in some world frame."""

    T_world_body: FloatArray  # (N, 4, 4)
    # (N,) strictly increasing; None: poses are numbered by frame, as in KITTI files
    times_ns: IntArray | None
    body: BodyFrame  # what the poses describe
    frame_indices: IntArray | None = None  # (N,) frame number of each pose where known
    orientations: Orientations = "stated"

    def __len__(self) -> int:
        return len(self.T_world_body)

    @property
    def positions(self) -> FloatArray:
        """Positions (N, 3) in the world frame, metres."""
        return self.T_world_body[:, :3, 3]

    def numbered(self) -> Trajectory:
        """Return a trajectory without times numbered by frame: pose k belongs to frame k of the
        recording.
        """
        if self.times_ns is not None or self.frame_indices is not None:
            return self
        return replace(self, frame_indices=np.arange(len(self), dtype=np.int64))

    def in_cam0(self, T_cam0_imu: FloatArray) -> Trajectory:
        """Return the same motion described by the left camera; unchanged if it already is.

        Positions without orientations stay where they are.
        """
        if self.body == "cam0":
            return self
        return self._of("cam0", se3_inverse(T_cam0_imu))

    def in_imu(self, T_cam0_imu: FloatArray) -> Trajectory:
        """Return the same motion described by the IMU; unchanged if it already is.

        Positions without orientations stay where they are.
        """
        if self.body == "imu":
            return self
        return self._of("imu", T_cam0_imu)

    def _of(self, body: BodyFrame, T_body_other: FloatArray) -> Trajectory:
        if self.orientations == "none":
            return replace(self, body=body)
        moved = self.T_world_body @ T_body_other
        return replace(self, T_world_body=moved, body=body, orientations="stated")


DOUBT = "doubtful: "  # begins what a note says after its file where it names two readings


def doubts_among(notes: Sequence[str]) -> tuple[str, ...]:
    """Return the notes that name two readings of a file, of which one had to be taken."""
    return tuple(note for note in notes if DOUBT in note)


@dataclass(frozen=True, slots=True)
class Recording:
    """What is known of a recording before its first frame is read."""

    kind: str  # "kitti", "ece276a", "utias", …
    path: Path
    camera: StereoCamera  # rectified
    T_cam0_imu: FloatArray | None  # (4, 4); None: no inertial sensor, the body is cam0
    frame_times_ns: IntArray  # (F,) strictly increasing
    has_images: bool
    motion: frozenset[MotionSource]  # which motion samples the events carry
    reference: Trajectory | None  # ground truth lying in the recording
    landmarks_reference: Landmarks | None = None  # surveyed landmark positions, covariance zero
    notes: tuple[str, ...] = ()  # what the reader found and corrected; a command logs each once
    motion_notes: tuple[str, ...] = ()  # those of them that are on motion samples only
    # observation logs: what the run behind the log used; None: not known
    run_motion: RunMotion | None = None
    # features: those that repeat old pixels are as the reader or `dataset.repeated_tracks` has them
    repeats_settled: bool = False
    # (F,) increasing, by which images are named where that counts frames; None: it does not
    image_numbers: IntArray | None = None

    @property
    def doubts(self) -> tuple[str, ...]:
        """The notes on what the files do not state and what their own numbers contradict."""
        return doubts_among(self.notes)

    @property
    def T_cam0_body(self) -> FloatArray:
        """Extrinsics (4, 4) of the body that a run estimates: the IMU, or cam0 itself where
        there is none.
        """
        return np.eye(4) if self.T_cam0_imu is None else self.T_cam0_imu


def need_stereo(recording: Recording, what: str) -> None:
    """Raise DataError unless a recording has two cameras, which `what` needs."""
    if recording.camera.kind != "stereo":
        cameras = (
            "one camera" if recording.camera.kind == "mono" else "one camera with depth images"
        )
        raise DataError(
            f"{recording.path}: {what} needs a stereo pair, and this recording has {cameras}"
        )


@dataclass(frozen=True, slots=True)
class LoopMatches:
    """The features that agree with a loop: what the keyframe and the frame show of the same
    points.
    """

    z_keyframe: FloatArray  # (P, 4) rectified pixels [ul vl ur vr] in the keyframe
    z_frame: FloatArray  # (P, 4) likewise in the frame that shows the place again
    has_right_keyframe: BoolArray  # (P,)
    has_right_frame: BoolArray  # (P,)

    def __len__(self) -> int:
        return len(self.z_frame)


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """A place of the map seen again."""

    frame: int  # number of the frame that shows it
    time_ns: int
    keyframe: int  # number in the map of the keyframe that showed it before
    keyframe_time_ns: int
    inliers: int  # corners of the frame that agree, with this keyframe or with those around it
    gap_m: float  # by which the loop moved the position of the frame, before the optimisation
    joined: bool  # whether it is the first link between two sessions
    # number of the keyframe's frame in this run; None: an earlier session's
    keyframe_frame: int | None = None
    # at the end of a run: whether it agrees with the other loops; those that do not move nothing
    kept: bool = True
    matches: LoopMatches | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class MapKeyframes:
    """The keyframes of a map that share a run's frame, at the end of the run."""

    keyframe: IntArray  # (K,) number in the map
    frame: IntArray  # (K,) number of the frame in its own recording
    time_ns: IntArray  # (K,)
    own: BoolArray  # (K,) whether it is of this run
    # (K, 4, 4) pose in the map of this run's body with its left camera at the keyframe's
    T_map_body: FloatArray
    covariance: FloatArray  # (K, 6, 6) of xi in `T_map_body exp(xi)`, relative to the first one


def no_map_keyframes() -> MapKeyframes:
    """Return none, as of a run without a map."""
    none = np.zeros(0, dtype=np.int64)
    return MapKeyframes(
        none, none, none, np.zeros(0, dtype=np.bool_), np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
    )


STAGES = ("read", "frontend", "monitor", "select", "filter")  # of a frame's wall time


@dataclass(frozen=True, slots=True)
class FrameLog:
    """What happened in one frame: one row of frames.csv."""

    index: int
    time_ns: int
    read_ms: float
    frontend_ms: float
    monitor_ms: float
    select_ms: float
    filter_ms: float
    detected: int
    tracked: int
    matched: int
    selected: int
    stale: int
    used: int
    gated: int
    landmarks: int
    innovation_median_px: float | None
    nis_per_dof: float | None
    # of the features with a right match; None: there is none
    disparity_median_px: float | None = None
    innovation_ratio: float | None = None
    integrity: int = 0  # of the estimate: 0 nominal, 1 degraded, 2 unusable
    stages_ms: dict[str, float] = field(default_factory=dict)  # the front end's own stages

    @property
    def total_ms(self) -> float:
        """Wall time of the whole frame."""
        return sum(getattr(self, f"{stage}_ms") for stage in STAGES)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Everything that came of one frame."""

    frame: StereoFrame
    output: FrontendOutput
    selection: Selection
    report: UpdateReport
    estimate: Estimate
    log: FrameLog
    # places of the map seen again, whose results have come with this frame
    loops: tuple[LoopEvent, ...] = ()
    is_keyframe: bool = False  # whether the frame becomes a keyframe of the map
