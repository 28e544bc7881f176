#!/usr/bin/env bash
# filterpy 2.0.0 (and its fork bayesian-filters 1.4.5): `FixedLagSmoother` is not the fixed-lag smoother, and where the motion matters beside the measurements it is worse than
# its own filter: a point with the accelerations of a hand, positions at 10 Hz with 3 cm of noise, is 10 cm off with a lag of 5 steps, its velocity 1.2 m/s;
# the filter has 3.0 cm and 0.7 m/s, the smoother of the same window 2.4 cm and 0.5 m/s. A longer lag does not help. Where motion is predictable it is nearly right.
# Guessed: a smoother is never worse than its filter: model, noise and start are exact and all is linear.
# Matters here: smoothing a track of poses, GNSS or a wheel before it is compared with a stereo trajectory adds errors that look like that trajectory's; no covariance
# of the smoothed states is stated that could tell. Rauch-Tung-Striebel over the same window (`rts_smoother`) is right, within 1 % of the optimum found by least squares.
# Source: its docstring (Simon, Optimal State Estimation, pages 274 to 278); fixed_lag_smoother.py of the wheel, whose gains begin with the updated covariance; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" filterpy==2.0.0 bayesian-filters==1.4.5 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib import import_module
from importlib.metadata import version

import numpy as np

STEP_S, STEPS, EDGE = 0.1, 2000, 160
F = np.array([[1, STEP_S], [0, 1]])
H = np.array([[1.0, 0]])
START = 0.01 * np.eye(2)


def optimum(Q, R, measured, lag):
    """Return each state from the measurements up to lag steps later: a least squares fit of the EDGE last
    steps and of those of the lag, which needs no formulas of smoothers.
    """
    past, found = EDGE, []
    size = past + lag + 1
    root_q, root_r = np.linalg.inv(np.linalg.cholesky(Q)), 1 / np.sqrt(R[0, 0])
    rows = np.zeros((2 * (size - 1) + size, 2 * size))
    for i in range(size - 1):
        rows[2 * i : 2 * i + 2, 2 * i : 2 * i + 4] = np.hstack([-root_q @ F, root_q])
    rows[2 * (size - 1) :, 0::2] = root_r * np.eye(size)
    gain = np.linalg.pinv(rows)[2 * past : 2 * past + 2, 2 * (size - 1) :] * root_r
    for k in range(EDGE, STEPS - EDGE):
        found.append(gain @ measured[k - past : k + lag + 1])
    return np.array(found)


def errors(package, power, variance, lag):
    """Return RMS errors of position and velocity by estimator."""
    kalman = import_module(f"{package}.kalman")
    rng = np.random.default_rng(0)
    Q = power * np.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]])
    R = np.array([[variance]])
    states = [np.linalg.cholesky(START) @ rng.normal(size=2)]
    for _ in range(STEPS - 1):
        states.append(F @ states[-1] + np.linalg.cholesky(Q) @ rng.normal(size=2))
    states = np.array(states)
    measured = states[:, 0] + np.sqrt(variance) * rng.normal(size=STEPS)

    def prepared(estimator):
        estimator.x, estimator.P = np.zeros((2, 1)), START.copy()
        estimator.F, estimator.H, estimator.Q, estimator.R = F, H, Q, R
        return estimator

    smoother = prepared(kalman.FixedLagSmoother(dim_x=2, dim_z=1, N=lag))
    filtered = []
    for z in measured:
        smoother.smooth(np.array([[z]]))
        filtered.append(smoother.x)
    plain = prepared(kalman.KalmanFilter(dim_x=2, dim_z=1))
    means, covariances, _, _ = plain.batch_filter(measured.reshape(-1, 1, 1))
    inside = slice(EDGE, STEPS - EDGE)
    windows = [
        plain.rts_smoother(means[k : k + lag + 1], covariances[k : k + lag + 1])[0][0]
        for k in range(EDGE, STEPS - EDGE)
    ]
    estimates = {
        "its filter": np.array(filtered)[inside],
        "KalmanFilter": means[inside],
        "FixedLagSmoother": np.array(smoother.xSmooth)[inside],
        "rts_smoother of windows": np.array(windows),
        "optimum": optimum(Q, R, measured, lag),
    }
    return {
        name: np.sqrt(np.mean((e.reshape(-1, 2) - states[inside]) ** 2, axis=0)) for name, e in estimates.items()
    }


for package, wheel in (("filterpy", "filterpy"), ("bayesian_filters", "bayesian-filters")):
    for name, power, variance in (("a hand", 10.0, 1e-3), ("predictable", 0.01, 1.0)):
        for lag in (5, 20):
            found = errors(package, power, variance, lag)
            print(f"{wheel} {version(wheel)}, {name}, lag {lag}: RMS error of position in m, of velocity in m/s")
            for estimator, rms in found.items():
                print(f"  {estimator}: {np.round(rms, 4)}")
            smoothed, filtered, best = (found[n] for n in ("FixedLagSmoother", "its filter", "optimum"))
            assert np.all(best < filtered) and np.allclose(found["rts_smoother of windows"], best, rtol=0.02)
            if name == "a hand":
                assert smoothed[0] > 2.5 * filtered[0] and smoothed[1] > 1.4 * filtered[1]
            else:
                assert np.all(smoothed < filtered) and np.allclose(smoothed, best, rtol=0.2)
PYTHON
