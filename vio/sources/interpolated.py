"""Gyro and accelerometer that are sampled apart, as one record: the accelerometer at the gyro's times."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from vio.geometry.lie import FloatArray
from vio.sources.source import SourceSample


class ImuInterpolation:
    """Holds samples of the gyro until the accelerometer has samples around them.

    The accelerometer's readings are interpolated linearly; samples of the gyro before its first one are left out.
    """

    def __init__(self) -> None:
        self._gyro: deque[tuple[int, FloatArray]] = deque()
        self._accel: deque[tuple[int, FloatArray]] = deque()

    def gyro(self, time_ns: int, value: FloatArray) -> Iterator[SourceSample]:
        """Take a sample (3,) rad/s of the gyro; yield what is complete."""
        if not self._gyro or time_ns > self._gyro[-1][0]:
            self._gyro.append((time_ns, value))
        yield from self._complete()

    def accel(self, time_ns: int, value: FloatArray) -> Iterator[SourceSample]:
        """Take a sample (3,) m/s^2 of the accelerometer; yield what is complete."""
        if not self._accel or time_ns > self._accel[-1][0]:
            self._accel.append((time_ns, value))
        yield from self._complete()

    def _complete(self) -> Iterator[SourceSample]:
        while self._gyro and self._accel and self._gyro[0][0] <= self._accel[-1][0]:
            time_ns, gyro = self._gyro.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= time_ns:
                self._accel.popleft()
            (t0, a0), (t1, a1) = self._accel[0], self._accel[min(1, len(self._accel) - 1)]
            if time_ns < t0:
                continue
            share = (time_ns - t0) / (t1 - t0) if t1 > t0 else 0.0
            yield SourceSample(time_ns, gyro, a0 + share * (a1 - a0))
