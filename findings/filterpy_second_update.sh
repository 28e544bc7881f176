#!/usr/bin/env bash
# filterpy 2.0.0: a second `update` of the unscented filter before the next `predict` uses the sigma points of the prediction, not those
# of the first update, so the same information is subtracted again. Two sensors as good as the prediction leave a variance of 0, better
# ones a negative one, with no error at that call; the position goes up to twice as far. The cubature filter does the same.
# Guessed: updates one after another, as the plain filter of the package does them: with independent noise the result is that of one stacked measurement.
# Matters here: poses of cameras, barometers and GNSS that are fused in such a filter come at the same time, one call each. With noisy
# sensors nothing fails: the filter is only too sure. `filter.sigmas_f = filter.points_fn.sigma_points(filter.x, filter.P)` between the calls mends it.
# Source: https://github.com/rlabbe/filterpy/issues/275 (how to call it for several sensors); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" filterpy==2.0.0 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import filterpy
import numpy as np
from filterpy.kalman import CubatureKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

TRANSITION = np.array([[1.0, 1.0], [0.0, 1.0]])


def made(kind):
    """Return a filter of position and velocity, predicted once: the position's variance is 2."""
    models = {"hx": lambda x: x[:1], "fx": lambda x, dt: TRANSITION @ x}
    if kind == "plain":
        one = KalmanFilter(2, 1)
        one.F, one.H = TRANSITION, np.array([[1.0, 0.0]])
    elif kind == "cubature":
        one = CubatureKalmanFilter(2, 1, 1.0, **models)
    else:
        one = UnscentedKalmanFilter(2, 1, 1.0, points=MerweScaledSigmaPoints(2, 0.1, 2.0, 1.0), **models)
    one.P, one.Q = np.eye(2), np.zeros((2, 2))
    one.predict()
    return one


def after_two(kind, variance, again=False):
    """Return position and variance after two sensors measured a position of 1 m."""
    one = made(kind)
    shape = (1, 1) if kind == "cubature" else (1,)
    for _ in range(2):
        one.update(np.ones(shape), R=np.eye(1) * variance)
        if again:
            one.sigmas_f = one.points_fn.sigma_points(one.x, one.P)
    return float(np.ravel(one.x)[0]), float(one.P[0, 0])


print("filterpy", filterpy.__version__, "position and variance after two sensors at 1 m, predicted 0 m with variance 2:")
for variance in (20.0, 2.0, 0.02):
    plain, unscented, cubature = (after_two(kind, variance) for kind in ("plain", "unscented", "cubature"))
    exact = 1 / (1 / 2 + 2 / variance)
    wrong = 2 - 2 * 2 * 2 / (2 + variance)
    print(
        f"  sensors' variance {variance}: plain {plain[0]:.3f} m, {plain[1]:.3f}; unscented {unscented[0]:.3f} m, {unscented[1]:.3f};"
        f" cubature {cubature[0]:.3f} m, {cubature[1]:.3f}"
    )
    assert np.isclose(plain[1], exact) and np.isclose(plain[0], 2 * exact / variance)
    assert np.allclose([unscented[1], cubature[1]], wrong, atol=1e-9)
    assert wrong < exact
assert unscented[1] < -1.9 and unscented[0] > 1.9
assert np.allclose(after_two("unscented", 2.0, again=True), after_two("plain", 2.0))
PYTHON
