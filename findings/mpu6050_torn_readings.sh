#!/usr/bin/env bash
# mpu6050-raspberrypi 1.2: the two bytes of a reading come by two transactions, between which the MPU-6050 puts the next sample into its registers. Where its upper byte changes, the reading has the upper byte
# of one sample and the lower one of another, and is 256 counts off: 2 degrees a second of the gyro, 0.15 m/s^2 of the accelerometer. At rest, with a true rate of 0 and noise of 5 counts, half
# of all readings of the gyro are such spikes, and their standard deviation is 1.35 degrees/s for 0.04; of the accelerometer, one in six. With a bias of 1 degree a second there is none.
# Guessed: a reading is one sample. The bus has transactions of several bytes for it, and the device holds its registers during one.
# Matters here: spikes of the same size, to both sides, in just some axes of some devices, by their bias, look like a damaged sensor, and at rest the gyro is 35 times too
# noisy. Axes are also of different times: 0.8 ms apart on a bus of 100 kHz. In motion few readings are at such a value: a run of EuRoC's MH_01 with its gyro torn so has an ATE of 3.79 mm for 3.75. A recording for `vio` needs one transaction of 14 bytes a sample, by `read_i2c_block_data` of smbus.
# Source: InvenSense, MPU-6000/MPU-6050 Register Map 4.2, 4.17 to 4.20: without burst reads, the user has to ensure that bytes are of one sampling instant; mpu6050/mpu6050.py; this run. In place of a Raspberry Pi's bus
# there is one with that rule of the register map: registers are renewed at the gyro's 8 kHz (no filter, as the package leaves it) or the accelerometer's 1 kHz, but not within a transaction of 0.38 ms.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" mpu6050-raspberrypi==1.2 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import sys
import types
from importlib.metadata import version

import numpy as np

BYTE_S = 38 / 100e3  # 38 bits a transaction at 100 kHz: address, register, address, byte, and their acknowledgements
RATES_HZ = {"accelerometer": 1000.0, "gyro": 8000.0}


class SMBus:
    """A bus with an MPU-6050 at rest."""

    mean = {"accelerometer": (0, 0, 16384), "gyro": (0, 0, 0)}  # counts at 2 g and 250 degrees/s
    noise = {"accelerometer": 40.0, "gyro": 5.0}

    def __init__(self, bus):
        self.now_s, self.samples, self.rng = 0.0, {}, np.random.default_rng(0)
        self.written = {}

    def _sample(self, sensor, start_s):
        tick = int(start_s * RATES_HZ[sensor])
        if self.samples.get(sensor, (None,))[0] != tick:
            counts = np.round(self.rng.normal(self.mean[sensor], self.noise[sensor])).astype(">i2")
            self.samples[sensor] = (tick, counts.tobytes())
        return self.samples[sensor][1]

    def write_byte_data(self, address, register, value):
        self.written[register] = value

    def read_byte_data(self, address, register):
        return self.read_i2c_block_data(address, register, 1)[0]

    def read_i2c_block_data(self, address, register, length):
        start_s = self.now_s
        self.now_s += BYTE_S + (length - 1) * 9 / 100e3
        if register < 0x3B or register > 0x48:
            return [self.written.get(register, 0)] * length
        held = self._sample("accelerometer", start_s) + b"\0\0" + self._sample("gyro", start_s)
        return list(held[register - 0x3B :][:length])


sys.modules["smbus"] = types.SimpleNamespace(SMBus=SMBus)
from mpu6050 import mpu6050  # noqa: E402

print("mpu6050-raspberrypi", version("mpu6050-raspberrypi"))


def shares(bias_counts):
    """Return the shares of readings that no sample has: of gyro and accelerometer, singly and in one transaction."""
    SMBus.mean = {"accelerometer": (bias_counts, 0, 16384), "gyro": (bias_counts, 0, 0)}
    device = mpu6050(0x68)
    gyro = np.array([device.get_gyro_data()["x"] for _ in range(4000)]) * 131 - bias_counts
    force = np.array([device.get_accel_data(g=True)["x"] for _ in range(4000)]) * 16384 - bias_counts
    burst = np.array([np.frombuffer(bytes(device.bus.read_i2c_block_data(0x68, 0x43, 6)), ">i2")[0] for _ in range(4000)]) - bias_counts
    print(f"true mean {bias_counts} counts: gyro between {gyro.min():.0f} and {gyro.max():.0f} of it, spikes {np.mean(np.abs(gyro) > 100):.3f}, standard deviation {gyro.std() / 131:.3f} for {5 / 131:.3f} degrees/s;")
    print(f"    accelerometer between {force.min():.0f} and {force.max():.0f}, spikes {np.mean(np.abs(force) > 200):.3f}; gyro in one transaction between {burst.min()} and {burst.max()}")
    return np.mean(np.abs(gyro) > 100), np.mean(np.abs(force) > 200), np.abs(burst).max()


gyro, force, burst = shares(0)
assert 0.4 < gyro < 0.6 and force > 0.05 and burst < 30
gyro, force, burst = shares(128)
assert gyro == 0 and burst < 30
gyro, force, burst = shares(256)
assert 0.4 < gyro < 0.6 and burst < 30
PYTHON
