"""Poses by prediction alone, beside the filter: the paper's first result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.filters.settings import VislamSettings
from vio.filters.vislam import Vislam
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import Event, StereoFrame


class DeadReckoning:
    """The paper's filter without its updates."""

    def __init__(self, camera: StereoCamera, T_cam0_body: FloatArray, settings: VislamSettings) -> None:
        settings = replace(settings, mode="dead_reckoning", motion_model="input")
        self._filter = Vislam(camera, T_cam0_body, settings, motion_sensor=True)
        self._begun = False

    def add(self, event: Event) -> None:
        """Take a motion sample."""
        if not isinstance(event, StereoFrame):
            self._filter.propagate(event)
            self._begun = True

    def pose_at(self, time_ns: int) -> FloatArray:
        """The pose (4, 4) of the body at a frame, which may not be older than the last one."""
        if not self._begun:  # at its start, as velocities may begin after the images
            return np.eye(4)
        self._filter.advance(time_ns)
        return self._filter.estimate().T_world_imu
