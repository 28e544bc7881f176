"""The sliding-window filter with one camera: its scale comes from the IMU, and it waits until
that is observable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vio.errors import ConfigError
from vio.filters.mono_start import START_FACTORS, MonoStart, MonoStarter, is_still
from vio.filters.msckf import Msckf
from vio.filters.navigation import DIM, ImuMotion, NavState
from vio.filters.noise import MotionNoise
from vio.filters.propagation import IMU_FACTORS
from vio.filters.restart import (
    GoodState,
    as_good_state,
    held_covariance,
    required,
    restarted,
)
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.filters.window_posterior import scale_sigma
from vio.geometry.lie import FloatArray, se3_adjoint, se3_from_parts, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.geometry.upright import nearest_yaw
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.imu.standstill import STANDSTILL_S
from vio.records import (
    Estimate,
    ImuSample,
    Initialisation,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    UpdateReport,
)

# Measured in docs/notes/design_decisions.md, "of one camera".
_LANDMARKS = 0  # one that is marginalised at a scale that is still off holds on to it
_MIN_CLONES = 20  # parallax comes from motion alone, so a second of poses instead of half
_WORLD = [0, 1, 2, 5]  # errors of position and yaw, which the start takes for the world's


class MonoMsckf(Msckf):
    """A sliding-window filter with one camera and an IMU.

    Until it has begun, `update` reports `started` False, and there is no estimate. After a
    divergence it begins anew and goes on in the same world, with the uncertainty of what passed in
    between.
    """

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: MsckfSettings,
        imu: ImuSettings = DEFAULT_IMU,
    ) -> None:
        """Prepare; the arguments are those of `Msckf`."""
        super().__init__(camera, T_cam0_imu, _for_one_camera(settings), motion="imu", imu=imu)
        self._starter = MonoStarter(camera, self._calibration.T_cam0_imu, settings, imu)
        self._begun: MonoStart | None = None
        self._resumed: GoodState | None = None  # after a divergence
        self._recent: deque[Observations] = deque()  # of the last half second
        self._samples: deque[ImuSample] = deque()  # likewise

    @classmethod
    def build(
        cls,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        settings: MsckfSettings,
        motion: MotionSource | None,
        imu: ImuSettings,
    ) -> MonoMsckf:
        """Build the filter of a run, see `Backend`.

        Raises:
            ConfigError: there is no IMU, or its scale is to be estimated.
        """
        if motion != "imu":
            raise ConfigError(
                "one camera alone knows no scale: add an IMU (imu.csv and T_cam0_imu; --motion "
                "none leaves it out), "
                "depth images or a second camera"
            )
        if settings.calibrate_imu not in ("auto", "off"):
            raise ConfigError(
                f"msckf.calibrate_imu: {settings.calibrate_imu} needs a stereo pair, as the scale "
                "of one camera is the "
                "accelerometer's; set it to auto"
            )
        return cls(camera, T_cam0_body, settings, imu)

    @property
    def initialisation(self) -> Initialisation:
        """The standard deviation of the scale at the initialisation, or why that is not possible
        yet.
        """
        if self._begun is None:
            return Initialisation(waits_for=self._starter.why)
        return Initialisation(scale_sigma=self._begun.scale_sigma)

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample, see `Msckf`."""
        super().propagate(sample)
        assert isinstance(sample, ImuSample)
        self._samples.append(sample)
        while (sample.time_ns - self._samples[0].time_ns) * 1e-9 > 1.2 * STANDSTILL_S:
            self._samples.popleft()

    def propagate_all(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples, see `propagate`."""
        for sample in samples:
            self.propagate(sample)

    def _update(self, observations: Observations) -> UpdateReport:
        self._recent.append(observations)
        while (observations.time_ns - self._recent[0].time_ns) * 1e-9 > 1.2 * STANDSTILL_S:
            self._recent.popleft()
        return super()._update(observations)

    def _start_state(self, seen: Observations) -> tuple[NavState, FloatArray] | None:
        """The state at a frame with its covariance (15, 15); None while it is not observable."""
        motion = self._propagation.motion
        assert isinstance(motion, ImuMotion)
        begun = self._starter.try_frame(seen, motion)
        if begun is None:
            return None
        self._begun = begun
        return (
            (begun.nav, begun.P)
            if self._resumed is None
            else self._placed(begun, self._resumed, seen.time_ns)
        )

    def _first_noise(self, P: FloatArray) -> MotionNoise:
        return MotionNoise(START_FACTORS, *IMU_FACTORS[1:])

    def _placed(
        self, begun: MonoStart, good: GoodState, time_ns: int
    ) -> tuple[NavState, FloatArray]:
        """A start after a divergence in the world of before, where position and yaw are those
        held since.
        """
        held, P_held = restarted(good, time_ns, self._propagation.motion)
        R = held.T_world_imu[:3, :3]
        R_new = begun.nav.T_world_imu[:3, :3]
        yaw = so3_exp([0.0, 0.0, nearest_yaw(R @ R_new.T)])
        T = se3_from_parts(yaw, held.T_world_imu[:3, 3])
        M = np.eye(DIM)
        M[:6, :6] = se3_adjoint(T)
        M[6:9, 6:9] = yaw
        P = M @ begun.P @ M.T
        P[np.ix_(_WORLD, _WORLD)] += P_held[np.ix_(_WORLD, _WORLD)]
        return replace(
            begun.nav, T_world_imu=T @ begun.nav.T_world_imu, velocity=yaw @ begun.nav.velocity
        ), P

    def restart(self, observations: Observations) -> UpdateReport:
        """Begin anew after a divergence, see `Msckf`; there is no estimate until the start is
        observable again.
        """
        self._wait_again(required(self._good))
        return self._update(observations)

    def begin_anew(self, good: Estimate) -> Estimate | None:
        """Wait for a new start in place of a state that has become impossible, see `Backend`."""
        last = self._good
        if last is None:
            return None
        now = replace(good, time_ns=self._propagation.time_ns)
        held = replace(now, covariance=held_covariance(good, now, np.array([0.0, 0.0, 1.0])))
        self._wait_again(as_good_state(last, good))
        return held

    def _wait_again(self, good: GoodState) -> None:
        """Forget the state; the next start is placed by a good one."""
        self._resumed = good
        self._window = None
        self._begun = None
        self._good = None
        self._propagation.forget()
        self._forget_tracks(good)
        self._starter = MonoStarter(
            self._rig.camera, self._calibration.T_cam0_imu, self._settings, self._imu
        )

    def _wait(self, observations: Observations) -> UpdateReport:
        return replace(super()._wait(observations), started=False)

    def landmarks(self) -> Landmarks:
        """Return the points of all tracks that fix their depth, see `Msckf`; while it waits to
        begin again, those of before.
        """
        if self._window is None and self._resumed is not None:
            return self._points.stored()
        return super().landmarks()

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last event, with the standard deviation of its
        scale.
        """
        smoothed = self._frame.smoothed
        return replace(
            super().estimate(), scale_sigma=None if smoothed is None else scale_sigma(smoothed)
        )

    def _apply_zero_velocity(self, window: Window) -> None:
        """Absorb a zero-velocity measurement where neither the tracks nor the IMU move; see
        `Msckf`.

        At standstill, tracks of one camera fix no point, and the window's posterior knows the IMU's
        motion alone.
        """
        now = self._recent[-1].time_ns
        if not self._settings.zero_velocity or now - STANDSTILL_S * 1e9 < self._stationary_ns:
            return
        if not is_still(self._recent, list(self._samples), self._imu):
            return
        measurement = self._propagation.motion.zero_velocity(window.nav, self._propagation.gyro)
        if measurement is not None:
            window.absorb_measurement(measurement)
            self._stationary_ns = now


def _for_one_camera(settings: MsckfSettings) -> MsckfSettings:
    clones = max(settings.clones, _MIN_CLONES)
    # Time offset and the accelerometer's scale trade against the scale, which the IMU alone gives.
    calibrate = "none" if settings.calibrate_camera_imu == "auto" else settings.calibrate_camera_imu
    return replace(
        settings,
        max_landmarks=_LANDMARKS,
        clones=clones,
        calibrate_camera_imu=calibrate,
        calibrate_imu="off",
    )
