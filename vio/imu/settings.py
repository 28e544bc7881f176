"""Settings of the inertial sensor, whatever uses it."""

from __future__ import annotations

from typing import ClassVar

from vio.dataclass import dataclass
from vio.records import ImuDensities
from vio.setting import Section, setting


@dataclass(frozen=True, slots=True)
class ImuSettings(Section):
    """The IMU: gravity, noise and biases."""

    section: ClassVar[str] = "imu"

    gravity_mps2: float = setting(9.81, "magnitude of gravity", unit="m/s^2", above=0, at_most=100)
    gyro_noise_density: float = setting(
        2.0e-4,
        "gyro white noise by its data sheet; what a rig adds to it is learned",
        unit="rad/s/sqrt(Hz)",
        above=0,
    )
    accel_noise_density: float = setting(
        1.2e-2, "accelerometer white noise, likewise", unit="m/s^2/sqrt(Hz)", above=0
    )
    gyro_bias_walk: float = setting(
        2.0e-5, "gyro bias random walk", unit="rad/s^2/sqrt(Hz)", at_least=0
    )
    accel_bias_walk: float = setting(
        3.0e-3, "accelerometer bias random walk", unit="m/s^3/sqrt(Hz)", at_least=0
    )
    gyro_bias_sigma_radps: float = setting(
        0.1, "initial standard deviation of the gyro bias", unit="rad/s", at_least=0
    )
    accel_bias_sigma_mps2: float = setting(
        0.3, "initial standard deviation of the accelerometer bias", unit="m/s^2", at_least=0
    )

    @property
    def densities(self) -> ImuDensities:
        """White noise and random walks of both sensors."""
        return ImuDensities(
            self.gyro_noise_density,
            self.gyro_bias_walk,
            self.accel_noise_density,
            self.accel_bias_walk,
        )


DEFAULT_IMU = ImuSettings()
