#!/usr/bin/env bash
# smfeval 0.4.0: covariances are of the right-hand tangent, in the axes of the body, and its NEES, coverage and log score take them
# so. Its CRPS and energy score take the same numbers as axes of the world: the same errors have 1.67 times the CRPS and 1.23 times
# the energy score once the body looks another way.
# Guessed: scores of one report share the frame, and none depends on how the body is called or turned.
# Matters here: our covariances are of that tangent. Of its report on a run of ours, NEES, coverage and log score hold; CRPS and
# energy score do not, unless the sigmas are the same in all directions.
# Source: smfeval.scoring on draws of the stated covariance, the body turned by 90 degrees or not; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" smfeval==0.4.0 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from scipy.spatial.transform import Rotation
from smfeval.format import TangentOrder
from smfeval.scoring.calibration import calibrate
from smfeval.scoring.crps import translation_crps
from smfeval.scoring.energy import energy_score
from smfeval.scoring.logscore import gaussian_log_score
from smfeval.steps import GaussianStep

ORDER = TangentOrder.TRANS_ROT
N = 1000
sigmas = np.array([1.0, 0.05, 0.05, 1e-6, 1e-6, 1e-6])  # along, across, up, and hardly any rotation
errors = np.random.default_rng(0).normal(0.0, sigmas[:3], (N, 3))  # in the axes of the body


def scores(heading_deg):
    body = Rotation.from_euler("z", heading_deg, degrees=True)
    step = GaussianStep(
        timestamp=0.0, translation=np.zeros(3), quat_xyzw=body.as_quat(), covariance=np.diag(sigmas**2)
    )
    true = body.apply(errors)  # where the body was, in the world
    quaternion = body.as_quat()
    calibrated = calibrate([step] * N, true, np.tile(quaternion, (N, 1)), ORDER)
    return {
        "log score": np.mean([gaussian_log_score(step, p, quaternion, ORDER).translation for p in true]),
        "coverage of 90 %": calibrated.coverage,
        "energy score": np.mean([energy_score(step, p, ORDER) for p in true]),
        "CRPS": np.mean([translation_crps(step, p, ORDER) for p in true]),
    }


print("smfeval", version("smfeval"))
ahead, across = scores(0.0), scores(90.0)
for name in ahead:
    ratio = across[name] / ahead[name]
    print(f"{name}: {ahead[name]:.4f}, body turned by 90 degrees {across[name]:.4f}, ratio {ratio:.3f}")
    assert (abs(ratio - 1) < 1e-6) == (name in ("log score", "coverage of 90 %"))
assert 0.87 < ahead["coverage of 90 %"] < 0.93
assert across["energy score"] > 1.2 * ahead["energy score"]
assert across["CRPS"] > 1.6 * ahead["CRPS"]
PYTHON
