"""Consistency of the calibration that the sliding-window filter estimates: NEES over flights whose
rig is off.

    python -m tools.calibration_consistency [--rigs RIG …] [--starts START …] [--runs 20] [--seconds
    10]
        [--pixel-sigma 0.5] [--jobs 2]

Monte-Carlo flights as those of `tools.consistency`, each with a rig that is off by what the priors
of the settings expect: the extrinsics of camera and IMU and their clocks, the IMU's scales and
misalignments, all of these, the right camera's attitude, or the length of the baseline. They begin
in motion, at a velocity that the filter does not know, or at standstill. Prints NEES of what is
estimated, halfway and at the end, in Markdown.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal, get_args

import numpy as np

from tools.consistency import CAMERA, IMU, SAMPLES, T_CAM0_IMU, Flight, Scenario
from vio.errors import VioError
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters.imu_terms import CHOSEN, IMU_TERMS, IMU_WALK, term_sigmas
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, se3_log, so3_exp
from vio.geometry.stereo import left_rays
from vio.numerics.threads import one_blas_thread
from vio.records import RIGHT_TERMS, Estimate, ImuSample, Observations, imu_matrices

Rig = Literal["camera-IMU", "IMU", "camera-IMU and IMU", "right camera turned", "baseline"]
RIGS: tuple[Rig, ...] = get_args(Rig)
Start = Literal["motion", "standstill"]
STARTS: tuple[Start, ...] = get_args(Start)
_STILL_S = 0.75
_FRAME_NS = 50_000_000
_IMU_NS = 5_000_000
# frames of samples around the flight: for the first tilt, and for the offset of clocks
_BEFORE = 10
_AFTER = 2
_BASELINE_SIGMA = 0.01
_ACCEL_TERMS = 6  # of the IMU's, the first


@dataclass(frozen=True, slots=True)
class Off:
    """What a rig is off by; zero where it is right."""

    xi: FloatArray  # (6,) in truth = T_cam0_imu exp(xi), m and rad
    offset_s: float  # a frame stamped t was exposed at t + offset of the IMU's clock
    turn: FloatArray  # (3,) rad: the right camera sees points p as exp(turn) p
    baseline: float  # logarithm of the true baseline over the calibrated one
    # (15,) first terms of (A1) of docs/math.md
    imu: FloatArray = field(default_factory=lambda: np.zeros(IMU_TERMS))


class FromStandstill(Flight):
    """The same way, begun at standstill."""

    def state(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As of `Flight`, at a time that begins to pass after a while, without a jump of the
        acceleration.
        """
        s = np.maximum(t - _STILL_S, 0.0)
        R, p, v = super().state(s**3 / (s**2 + 1))
        return R, p, v * ((s**4 + 3 * s**2) / (s**2 + 1) ** 2)[:, None]


def settings_of(rig: Rig, pixel_sigma_px: float) -> MsckfSettings:
    """Return the filter's settings: the truth about all noise, and what is estimated of the rig."""
    known = replace(
        Scenario(pixel_sigma_px=pixel_sigma_px).settings(learn_noise=False), calibrate_stereo="off"
    )
    if rig == "IMU":
        return replace(known, calibrate_imu="full")
    if rig == "camera-IMU and IMU":
        return replace(known, calibrate_camera_imu="both", calibrate_imu="full")
    if rig == "camera-IMU":
        return replace(known, calibrate_camera_imu="both")
    if rig == "baseline":
        return replace(known, calibrate_scale="on", stereo_baseline_sigma=_BASELINE_SIGMA)
    return replace(known, calibrate_stereo="on")


def drawn(rig: Rig, settings: MsckfSettings, noise: np.random.Generator) -> Off:
    """Draw what a rig is off by from the priors of the settings; turns about all axes from that
    about the vertical.
    """
    s = settings
    right = Off(np.zeros(6), 0.0, np.zeros(3), 0.0)
    if rig == "IMU":
        return replace(right, imu=noise.normal(0, term_sigmas()))
    if rig == "camera-IMU and IMU":
        return replace(drawn("camera-IMU", s, noise), imu=noise.normal(0, term_sigmas()))
    if rig == "camera-IMU":
        sigmas = np.repeat(
            [s.extrinsic_translation_sigma_m, np.radians(s.extrinsic_rotation_sigma_deg)], 3
        )
        return replace(
            right,
            xi=noise.normal(0, sigmas),
            offset_s=float(noise.normal(0, s.time_offset_sigma_s)),
        )
    if rig == "baseline":
        return replace(right, baseline=float(noise.normal(0, s.stereo_baseline_sigma)))
    return replace(right, turn=noise.normal(0, np.radians(s.stereo_yaw_sigma_deg), 3))


@one_blas_thread()
def fly(
    rig: Rig, start: Start, seed: int, seconds: float = 10.0, pixel_sigma_px: float = 0.5
) -> list[dict[str, float]]:
    """Fly once; return NEES by what is estimated, halfway and at the end."""
    scenario = Scenario(seconds, pixel_sigma_px)
    with scenario.priors(learn_noise=False):
        return _fly(rig, start, seed, scenario)


def _fly(rig: Rig, start: Start, seed: int, scenario: Scenario) -> list[dict[str, float]]:
    pixel_sigma_px = scenario.pixel_sigma_px
    flight = Flight() if start == "motion" else FromStandstill()
    settings = settings_of(rig, pixel_sigma_px)
    noise = np.random.default_rng(seed)
    off = drawn(rig, settings, np.random.default_rng(10_000 + seed))
    filt = Msckf(CAMERA, T_CAM0_IMU @ se3_inverse(se3_exp(off.xi)), settings, motion="imu", imu=IMU)
    R, p, _ = flight.state(np.arange(scenario.frames, dtype=np.float64) * 1e-9 * _FRAME_NS)
    T = se3_from_parts(R, p)
    numbers = range(-SAMPLES * _BEFORE, SAMPLES * (scenario.frames + _AFTER))
    samples, _ = flight.imu(numbers, noise, IMU, clock_s=off.offset_s)
    terms = walked_terms(off, len(samples), settings, np.random.default_rng(20_000 + seed))
    samples = [_misread(sample, own) for sample, own in zip(samples, terms, strict=True)]
    fed_ns = -1_000_000_000
    ahead_s = 0.0
    halves: list[dict[str, float]] = []
    for k in range(scenario.frames):
        # As in the pipeline: with the sample at or after the exposure, by the offset estimated so
        # far.
        while fed_ns < k * _FRAME_NS + round(1e9 * max(ahead_s, 0.0)):
            fed_ns = samples[0].time_ns
            filt.propagate(samples.pop(0))
        filt.update(_seen(flight.frame(k, T[k], scenario, noise), off))
        estimate = filt.estimate()
        ahead_s = estimate.time_offset_s or 0.0
        if k + 1 in (scenario.frames // 2, scenario.frames):
            now = terms[min(SAMPLES * (k + _BEFORE), len(terms) - 1)]
            halves.append(calibration_nees(estimate, off) | imu_nees(filt, now))
    return halves


def walked_terms(
    off: Off, count: int, settings: MsckfSettings, noise: np.random.Generator
) -> FloatArray:
    """Return the IMU's terms (count, 15) at each sample, which walk as the filter has it where
    they are not zero.
    """
    steps = (
        noise.normal(0, 1, (count, IMU_TERMS)) * term_sigmas() * IMU_WALK * np.sqrt(1e-9 * _IMU_NS)
    )
    return off.imu + np.cumsum(steps * (off.imu != 0), axis=0)


def _misread(sample: ImuSample, terms: FloatArray) -> ImuSample:
    """Return what an IMU of some terms (15,) reads in the place of a perfect one."""
    M_accel, M_gyro = imu_matrices(terms)
    gyro = np.linalg.solve(M_gyro, sample.gyro)
    accel = np.linalg.solve(M_accel, sample.accel)
    return ImuSample(
        sample.time_ns, np.asarray(gyro, dtype=np.float64), np.asarray(accel, dtype=np.float64)
    )


def _seen(expected: Observations, off: Off) -> Observations:
    """Return what a rig that is off shows in the place of pixels of the calibrated one."""
    z = expected.z.copy()
    z[:, 2] = z[:, 0] - (z[:, 0] - z[:, 2]) * np.exp(off.baseline)
    if off.turn.any():
        q = left_rays(CAMERA, z[:, 2:]) @ so3_exp(off.turn).T
        z[:, 2:] = q[:, :2] / q[:, 2:] * [CAMERA.fu, CAMERA.fv] + [CAMERA.cu, CAMERA.cv]
    return replace(expected, z=z)


def calibration_nees(estimate: Estimate, off: Off) -> dict[str, float]:
    """Return NEES by what an estimate holds of the calibration; names end in the dimension, in
    brackets.
    """
    out = {}
    if estimate.T_cam0_imu is not None and estimate.T_cam0_imu_covariance is not None:
        error = se3_log(se3_inverse(estimate.T_cam0_imu) @ T_CAM0_IMU)
        P = estimate.T_cam0_imu_covariance
        out["T_cam0_imu (6)"] = float(nees(error[None], P[None])[0])
        out["its translation (3)"] = float(nees(error[None, :3], P[None, :3, :3])[0])
        out["its rotation (3)"] = float(nees(error[None, 3:], P[None, 3:, 3:])[0])
    if estimate.time_offset_s is not None and estimate.time_offset_sigma_s is not None:
        out["time offset (1)"] = (
            (estimate.time_offset_s - off.offset_s) / estimate.time_offset_sigma_s
        ) ** 2
    if estimate.stereo_field is not None:
        yaw = off.turn[1]  # (R1) in the terms of (R3): a0 and a2; the rows give the rest
        error = estimate.stereo_field.coefficients.copy()
        P = estimate.stereo_field.covariance
        n = RIGHT_TERMS
        error[[0, 2]] -= yaw
        out[f"right columns ({n})"] = float(nees(error[None, :n], P[None, :n, :n])[0])
        out[f"both lenses ({len(error) - n})"] = float(nees(error[None, n:], P[None, n:, n:])[0])
    if estimate.stereo_scale is not None:
        error = estimate.stereo_scale.logs[:1] - off.baseline
        out["baseline (1)"] = float(error[0] ** 2 / estimate.stereo_scale.covariance[0, 0])
    return out


def imu_nees(filt: Msckf, truth: FloatArray) -> dict[str, float]:
    """Return NEES of the IMU's terms (15,), by sensor and kind; empty where they are not
    estimated.
    """
    terms = filt.estimate().imu_terms
    P = filt.imu_terms_covariance()
    if terms is None:
        return {}
    error = terms - truth
    index = np.arange(IMU_TERMS)
    accel = index < _ACCEL_TERMS
    scale = np.isin(index, CHOSEN["scale"])
    parts = {
        "accelerometer scale": accel & scale,
        "its misalignment": accel & ~scale,
        "gyro scale": ~accel & scale,
        "gyro misalignment": ~accel & ~scale,
        "IMU": np.ones(IMU_TERMS, dtype=np.bool_),
    }
    return {
        f"{name} ({own.sum()})": float(nees(error[None, own], P[np.ix_(own, own)][None])[0])
        for name, own in parts.items()
    }


def table(results: dict[tuple[Rig, Start], list[list[dict[str, float]]]]) -> str:
    """Return mean NEES ± its standard error over the runs as Markdown, with the band of the
    mean.
    """
    lines = [
        "| rig | begun in | estimated (dimension) | NEES halfway | at the end | 95 % band |",
        "|---|---|---|---:|---:|---:|",
    ]
    for (rig, start), runs in results.items():
        for name in runs[0][0]:
            dimension = int(name.rpartition("(")[2].rstrip(")"))
            low, high = nees_bounds(dimension, len(runs))
            cells = [_mean_text([run[half][name] for run in runs]) for half in range(2)]
            lines.append(
                f"| {rig} | {start} | {name} | {' | '.join(cells)} | {low:.2f} to {high:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _mean_text(values: list[float]) -> str:
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=min(len(values) - 1, 1)) / np.sqrt(len(values)):.2f}"


def main() -> int:
    """Fly everything and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", nargs="+", default=list(RIGS), choices=RIGS, help="what is off")
    parser.add_argument(
        "--starts", nargs="+", default=list(STARTS), choices=STARTS, help="how flights begin"
    )
    parser.add_argument("--runs", type=int, default=20, help="flights per rig")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a flight")
    parser.add_argument("--pixel-sigma", type=float, default=0.5, help="noise of a pixel")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    args = parser.parse_args()
    groups = list(product(args.rigs, args.starts))
    jobs = [
        (*group, seed, args.seconds, args.pixel_sigma)
        for group, seed in product(groups, range(args.runs))
    ]
    results: dict[tuple[Rig, Start], list[list[dict[str, float]]]] = {group: [] for group in groups}
    try:
        with ProcessPoolExecutor(max(args.jobs, 1)) as pool:
            for job, halves in zip(jobs, pool.map(fly, *zip(*jobs, strict=True)), strict=True):
                results[job[0], job[1]].append(halves)
                print(*job[:3], file=sys.stderr)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
