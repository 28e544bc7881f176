"""Standstill, units, gravity and noise of an IMU's record, and its place in the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.datasets.rigs.plausible import FAR_IMU_M
from vio.geometry.lie import FloatArray, so3_log
from vio.inspection.finding import Part
from vio.monitor.accelerometer import judge_up
from vio.monitor.samples import judge_size
from vio.records import NS_PER_S, BoolArray, ImuDensities, ImuRecord


@dataclass(frozen=True, slots=True)
class _StillRules:
    """When an IMU stands still for long enough to measure its noise."""

    window_s: float = 0.5  # over which standstill is judged
    gyro: float = 0.02  # rad/s, m/s^2: spread within a window; ten times the noise of usual sensors
    accel: float = 0.15
    min_still_s: float = 3.0  # of one piece, for the noise


_STILL = _StillRules()
# Allan deviations where white noise outweighs quantisation and bias drift
_NOISE_TAUS_S = (0.1, 0.2, 0.5)
_OFF_SHEET = 3.0  # measured over stated noise that is worth saying


def still_windows(record: ImuRecord) -> tuple[BoolArray, int]:
    """Return which windows of the record are at rest (W,), and the samples in each."""
    rate_hz = NS_PER_S / float(np.median(np.diff(record.times_ns)))
    size = max(round(_STILL.window_s * rate_hz), 4)
    count = len(record.times_ns) // size
    gyro, accel = (v[: count * size].reshape(count, size, 3) for v in (record.gyro, record.accel))
    quiet = (np.linalg.norm(gyro.std(axis=1), axis=1) < _STILL.gyro) & (
        np.linalg.norm(accel.std(axis=1), axis=1) < _STILL.accel
    )
    return quiet, size


def rest_part(record: ImuRecord, T_cam0_imu: FloatArray | None) -> Part:
    """Describe standstill, the accelerometer's unit and the direction of gravity."""
    if len(record.times_ns) < 8:
        return Part("rest", "too few samples", {})
    still, size = still_windows(record)
    share = float(still.mean()) if len(still) else 0.0
    faults = []
    unit = judge_size(record.times_ns, record.accel)
    if unit.finding is not None:
        faults.append(unit.finding.message)
    if still.any():
        mask = np.repeat(still, size)
    else:
        mask = np.ones(len(record.accel), dtype=np.bool_)
    force = record.accel[: len(mask)][mask].mean(axis=0)
    facts = {
        "still_share": share,
        "starts_still": bool(still[:2].all()) if len(still) > 1 else None,
    }
    facts |= {"force_mps2": force.tolist(), "force_norm_mps2": float(np.linalg.norm(force))}
    where = "at rest" if still.any() else "on average (never at rest)"
    text = f"{100 * share:.0f} % of the time; the accelerometer shows {np.linalg.norm(force):.2f} m/s^2 {where}"
    if T_cam0_imu is not None:
        up = T_cam0_imu[:3, :3] @ (force / max(float(np.linalg.norm(force)), 1e-9))
        # the camera's y axis points down
        tilt = float(np.degrees(np.arccos(np.clip(-up[1], -1, 1))))
        facts["camera_tilt_deg"] = tilt
        text += f"; the camera is tilted by {tilt:.0f} deg from upright"
        if still.any():
            faults += [f.message for f in judge_up(force[None], T_cam0_imu[:3, :3], measured=False)]
    return Part("rest", text, facts, faults)


def allan_deviation(values: FloatArray, step_s: float, tau_s: float) -> float:
    """Overlapping Allan deviation of readings (N, 3) at an averaging time; the root mean square
    over the axes.

    Reference: IEEE Std 952, annex C.
    """
    m = max(round(tau_s / step_s), 1)
    total = np.cumsum(np.vstack([np.zeros((1, 3)), values]), axis=0) * step_s
    second = total[2 * m :] - 2 * total[m:-m] + total[: -2 * m]
    return float(np.sqrt(np.mean(second**2) / (2 * (m * step_s) ** 2)))


def noise_part(record: ImuRecord, stated: ImuDensities | None) -> Part | None:
    """Compare the white noise in the longest standstill with the data sheet.

    None: no standstill is long enough.
    """
    still, size = still_windows(record)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    step_s = float(np.median(np.diff(record.times_ns))) / NS_PER_S
    runs = [(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    longest = max(runs, key=lambda r: r[1] - r[0], default=(0, 0))
    if (longest[1] - longest[0]) * size * step_s < _STILL.min_still_s:
        return None
    piece = slice(longest[0] * size, longest[1] * size)
    facts: dict[str, float | None] = {}
    texts = []
    for name, values, sheet in (
        ("gyro", record.gyro[piece], None if stated is None else stated.gyro),
        ("accel", record.accel[piece], None if stated is None else stated.accel),
    ):
        # Of white noise the deviation falls with the root of the averaging time; drift would only
        # add.
        density = min(allan_deviation(values, step_s, tau) * np.sqrt(tau) for tau in _NOISE_TAUS_S)
        facts |= {f"{name}_density": float(density), f"{name}_stated": sheet}
        if sheet is None:
            of = ""
        else:
            of = f" ({density / sheet:.1f} times the stated)"
        hint = (
            "; state the measured one" if sheet is not None and density > _OFF_SHEET * sheet else ""
        )
        texts.append(f"{name} {density:.2g}{of}{hint}")
    rest_s = (piece.stop - piece.start) * step_s
    return Part("noise", f"{', '.join(texts)} per root Hz, at rest for {rest_s:.1f} s", facts)


def extrinsics_part(T_cam0_imu: FloatArray) -> Part:
    """Describe the IMU's place in the rectified left camera."""
    R = T_cam0_imu[:3, :3]
    t = T_cam0_imu[:3, 3]
    turn = np.degrees(so3_log(R))
    distance = float(np.linalg.norm(t))
    faults = []
    if distance > FAR_IMU_M:
        faults.append(
            f"the IMU is {distance:.4g} m from the camera; translations are metres: check the unit"
        )
    text = (
        f"the IMU is at {t[0]:+.3f} {t[1]:+.3f} {t[2]:+.3f} m in cam0, turned by {turn[0]:+.1f} "
        f"{turn[1]:+.1f} "
        f"{turn[2]:+.1f} deg"
    )
    return Part(
        "extrinsics", text, {"t_cam0_imu_m": t.tolist(), "rotation_deg": turn.tolist()}, faults
    )
