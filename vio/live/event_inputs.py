"""The calls by which a program gives samples and images; `Odometry` and `LiveOdometry` share
them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Generic, TypeVar

import numpy.typing as npt

from vio.live.inputs import GivenFrame, Inputs
from vio.records import MotionSample

Result = TypeVar("Result")  # of a frame


class EventInputs(ABC, Generic[Result]):
    """Checks what is given, numbers frames, and hands both on."""

    _copies = True  # whether images are copied
    # held from the check of an event until it is taken
    _checking: AbstractContextManager[object] = nullcontext()

    @property
    @abstractmethod
    def inputs(self) -> Inputs:
        """The checks of the present trajectory."""

    @abstractmethod
    def take(self, given: GivenFrame | Sequence[MotionSample] | None) -> Result:
        """Take what `inputs` has checked; None: the frame is left out."""

    def add_imu(self, t_ns: int | npt.ArrayLike, gyro: npt.ArrayLike, accel: npt.ArrayLike) -> None:
        """Take one IMU sample, or several in order of time.

        Args:
            t_ns: time, or times (N,), in nanoseconds on the IMU's clock.
            gyro: (3,) or (N, 3) rad/s.
            accel: (3,) or (N, 3) m/s^2, specific force: about +9.81 upwards at rest.

        Raises:
            DataError: a wrong shape, a value that is not finite, or a time not after the last
                sample's.
            ConfigError: this odometry does not use an IMU.
        """
        with self._checking:
            self.take(self.inputs.samples("imu", t_ns, gyro, accel))

    def add_velocity(
        self, t_ns: int | npt.ArrayLike, linear: npt.ArrayLike, angular: npt.ArrayLike
    ) -> None:
        """Take one sample of body velocity, or several in order of time.

        Args:
            t_ns: time, or times (N,), in nanoseconds on the sensor's clock.
            linear: (3,) or (N, 3) m/s, body frame.
            angular: (3,) or (N, 3) rad/s, body frame.

        Raises:
            DataError: a wrong shape, a value that is not finite, or a time not after the last
                sample's.
            ConfigError: this odometry does not use velocities; set `motion` to velocity.
        """
        with self._checking:
            self.take(self.inputs.samples("velocity", t_ns, linear, angular))

    def add_stereo(self, t_ns: int, left: npt.ArrayLike, right: npt.ArrayLike) -> Result:
        """Take a pair of images.

        `Odometry` returns the newest estimate that it brought; None: it waits for IMU samples, the
        front end refused it with a warning (of swapped cameras, for instance), or it came sooner
        than `dataset.max_frame_rate` allows. `LiveOdometry` returns None at once.

        Args:
            t_ns: time of the exposure in nanoseconds.
            left: (H, W) uint8 gray or (H, W, 3) uint8 BGR, raw or rectified as the rig says.
            right: likewise.

        Raises:
            DataError: a wrong type, shape or size, or a time not after the last frame's.
        """
        return self.add_images(t_ns, left, right)

    def add_images(
        self,
        t_ns: int,
        left: npt.ArrayLike,
        right: npt.ArrayLike | None = None,
        *,
        depth_m: npt.ArrayLike | None = None,
    ) -> Result:
        """Take the image of one camera, with depths where it has them; with a right image, as
        `add_stereo`.

        One camera with an IMU has no estimate until the scale is observable: the return value is
        None until then.

        Args:
            t_ns: time of the exposure in nanoseconds.
            left: (H, W) uint8 gray or (H, W, 3) uint8 BGR, distorted or not as the rig says.
            right: likewise, where the rig has two cameras.
            depth_m: (H, W) metres along the optical axis of each pixel of the image, 0 where it is
                not known.

        Raises:
            DataError: a wrong type, shape or size, a time not after the last frame's, or images of
                another rig's kind.
        """
        with self._checking:
            return self.take(self.inputs.images(t_ns, left, right, depth_m, copy=self._copies))

    def add_observations(
        self,
        t_ns: int,
        ids: npt.ArrayLike,
        z: npt.ArrayLike,
        has_right: npt.ArrayLike | None = None,
    ) -> Result:
        """Take what a front end of the caller's own detected in a frame; the return value is that
        of `add_stereo`.

        Args:
            t_ns: time of the exposure in nanoseconds.
            ids: (N,) unique; an id names one feature for ever.
            z: (N, 4) rectified pixels [ul vl ur vr].
            has_right: (N,) whether the feature is seen in the right image; None: all are.

        Raises:
            DataError: shapes disagree, an id occurs twice, a pixel is not finite, a time not after
                the last one, or the first frames show pixels or ids that are not what they must be
                (`vio.datasets.feature_forms`).
        """
        with self._checking:
            return self.take(self.inputs.observations(t_ns, ids, z, has_right))
