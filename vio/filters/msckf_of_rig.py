"""Which sliding-window filter a run has: that of two cameras, of one, or with an IMU that may begin
late.
"""

from __future__ import annotations

from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.filters.supervised import SupervisedMsckf
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.settings import ImuSettings
from vio.protocols import Backend
from vio.records import MotionSource


class MsckfOfRig(Msckf):
    """The sliding-window filter as a back end: `build` chooses the class for the cameras and the
    motion sensor.
    """

    @classmethod
    def build(
        cls,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        settings: MsckfSettings,
        motion: MotionSource | None,
        imu: ImuSettings,
    ) -> Backend:
        """Build the filter of a run, see `Backend`.

        Raises:
            ConfigError: one camera without an IMU, or settings that need another motion or camera.
        """
        if camera.kind == "mono":
            from vio.filters.mono_msckf import MonoMsckf

            return MonoMsckf.build(camera, T_cam0_body, settings, motion, imu)
        if motion == "imu":
            return SupervisedMsckf(camera, T_cam0_body, settings, imu)
        return Msckf(camera, T_cam0_body, settings, motion=motion, imu=imu)
