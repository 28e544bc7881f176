"""Poses between frames where samples, estimates and questions come from different threads."""

from __future__ import annotations

import threading
from collections import deque

from vio.live.prediction import PosePredictor, PredictedPose
from vio.records import Estimate, MotionSample


class SharedPredictor:
    """A `PosePredictor` to which adding takes microseconds: what is added is integrated by who asks, or later."""

    def __init__(self, gravity_mps2: float) -> None:
        self._predictor = PosePredictor(gravity_mps2)
        self._added: deque[MotionSample | Estimate] = deque()
        self._lock = threading.Lock()

    def add(self, event: MotionSample | Estimate) -> None:
        """Take a motion sample or an estimate; samples come in order of time, and so do estimates."""
        self._added.append(event)

    def catch_up(self) -> None:
        """Integrate what was added, unless another thread is at it."""
        if self._lock.acquire(blocking=False):
            try:
                self._integrate()
            finally:
                self._lock.release()

    def predict(self, time_ns: int) -> PredictedPose:
        """Return the pose at a time, see `PosePredictor.predict`."""
        with self._lock:
            self._integrate()
            return self._predictor.predict(time_ns)

    def _integrate(self) -> None:
        while self._added:
            event = self._added.popleft()
            if isinstance(event, Estimate):
                self._predictor.estimate(event)
            else:
                self._predictor.sample(event)
