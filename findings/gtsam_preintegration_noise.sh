#!/usr/bin/env bash
# GTSAM 4.3.0: parameters of IMU preintegration that nobody has set are the identity, the integration
# covariance and both bias random walks among them: 1 m/s per root second of position error by integrating alone.
# Guessed: zero, or a small number, where only the noise of the two sensors is set.
# Matters here: whoever compares our covariances with a CombinedImuFactor's must set all of them.
# Source: gtsam.PreintegrationCombinedParams; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" gtsam==4.3.0
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import gtsam
import numpy as np
from importlib.metadata import version

params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
params.setAccelerometerCovariance(1e-4 * np.eye(3))
params.setGyroscopeCovariance(1e-6 * np.eye(3))
params.setBiasAccCovariance(1e-8 * np.eye(3))
params.setBiasOmegaCovariance(1e-8 * np.eye(3))
print("gtsam", version("gtsam"))
sigmas = []
for integration in (None, 1e-10):
    if integration is not None:
        params.setIntegrationCovariance(integration * np.eye(3))
    combined = gtsam.PreintegratedCombinedMeasurements(params)
    for _ in range(100):
        combined.integrateMeasurement(np.array([0, 0, 9.81]), np.zeros(3), 0.01)
    sigmas.append(float(np.sqrt(combined.preintMeasCov()[3, 3])))
print(f"sigma of the position after 1 s at rest: {sigmas[0]:.3f} m unset, {sigmas[1]:.4f} m set")
assert np.array_equal(gtsam.PreintegrationCombinedParams.MakeSharedU(9.81).getIntegrationCovariance(), np.eye(3))
assert sigmas[0] > 0.9
assert sigmas[1] < 0.03
PYTHON
