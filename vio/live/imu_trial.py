"""What to do with an IMU that turns out to be wrong: begin again, with its readings in the right
unit or without them.

A wrong unit, axis or sign is certain only after seconds of motion, and by then the estimate is
lost; that something is wrong shows in the first one. So the first minute of what the back end was
given is kept beside a back end that has not begun. Once the IMU is in doubt, and once the monitor is
certain, that one takes all of it again, and its estimates replace those before. Features are
tracked well without the filter's prediction, so they are not extracted again.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vio.errors import DivergedError, EstimationError
from vio.geometry.lie import so3_exp
from vio.imu.findings import ImuVerdict
from vio.monitor.update_checks import UpdatedFrame
from vio.numerics.kinds import Capacity
from vio.protocols import Backend
from vio.records import ImuSample, MotionSample, Observations

_MAX_FRAMES: Capacity[int] = 600  # that are kept
AS_GIVEN = ImuVerdict()


class ImuTrial:
    """Keeps what a back end is given until its IMU is known to be right, or too much has come."""

    def __init__(self, backend: Backend) -> None:
        """Begin; `backend` has not taken anything yet."""
        self._fresh: Backend | None = copy.deepcopy(backend)
        self._taken: list[MotionSample | Observations] = []
        self._frames = 0

    @property
    def open(self) -> bool:
        """Whether everything can still be taken again."""
        return self._fresh is not None

    def close(self) -> None:
        """Forget all."""
        self._fresh = None
        self._taken = []

    def take_samples(self, samples: Sequence[MotionSample]) -> None:
        """Take samples as they were recorded."""
        if self._fresh is not None:
            self._taken += samples

    def take(self, seen: Observations) -> None:
        """Take the observations of a frame, as they are given to the back end."""
        if self._fresh is None:
            return
        self._taken.append(seen)
        self._frames += 1
        if self._frames > _MAX_FRAMES:
            self.close()

    def again(self, verdict: ImuVerdict) -> tuple[Backend, list[UpdatedFrame]] | None:
        """Give everything to a new back end, with the IMU that a verdict leaves; but for a doubt and
        its end, nothing can be taken again then.

        Return that back end and its frames; None: it is lost, too.
        """
        backend = self._fresh
        taken = self._taken
        assert backend is not None
        if verdict.in_doubt or verdict == AS_GIVEN:
            backend = copy.deepcopy(backend)
        else:
            self.close()
        try:
            return backend, _frames(backend, taken, verdict)
        except EstimationError:
            self.close()
            return None


def _frames(
    backend: Backend, taken: list[MotionSample | Observations], verdict: ImuVerdict
) -> list[UpdatedFrame]:
    """Give everything to a back end; return the frames that have an estimate."""
    frames = []
    for event in taken:
        if isinstance(event, Observations):
            restarted = ""
            try:
                report = backend.update(event)
            except DivergedError as error:
                restarted = str(error)
                report = backend.restart(event)
            if report.started:
                frames.append(UpdatedFrame(event, report, backend.estimate(), restarted))
        elif (sample := corrected(event, verdict)) is not None:
            backend.propagate(sample)
    return frames


def corrected_all(samples: Sequence[MotionSample], verdict: ImuVerdict) -> Sequence[MotionSample]:
    """Return samples in the right units, less those that are not to be used."""
    if verdict is AS_GIVEN:
        return samples
    return [x for x in (corrected(sample, verdict) for sample in samples) if x is not None]


def corrected(sample: MotionSample, verdict: ImuVerdict) -> MotionSample | None:
    """Return a sample in the right units and axes; None: it is not to be used."""
    if verdict is AS_GIVEN or verdict == AS_GIVEN or not isinstance(sample, ImuSample):
        return sample
    if not verdict.used:
        return None
    gyro = verdict.gyro_factor * sample.gyro
    accel = verdict.accel_factor * sample.accel
    if any(verdict.turn_rad):
        R = so3_exp(np.array(verdict.turn_rad))
        gyro = R @ gyro
        accel = R @ accel
    return replace(sample, gyro=gyro, accel=accel)
