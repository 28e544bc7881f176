#!/usr/bin/env bash
# DepthAI 3.12.0: the baseline that `getBaselineDistance` returns is that of the drawing of the board,
# while `getCameraExtrinsics` of the same two cameras returns the calibrated one. Both are centimetres.
# Guessed: one handler, one baseline.
# Matters here: depth scales with the baseline; a rig must be made from the extrinsics.
# Source: docstrings of depthai.CalibrationHandler, default of useSpecTranslation; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" depthai==3.12.0
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import depthai as dai

stored = dai.CalibrationHandler()
left = dai.CameraBoardSocket.CAM_B
right = dai.CameraBoardSocket.CAM_C
for socket in (left, right):
    stored.setCameraIntrinsics(socket, [[800.0, 0, 640], [0, 800.0, 400], [0, 0, 1]], 1280, 800)
    stored.setCameraType(socket, dai.CameraModel.Perspective)
turn = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]
stored.setCameraExtrinsics(left, right, turn, [-7.62, 0.0, 0.0], [-7.5, 0.0, 0.0])
calibrated = -stored.getCameraExtrinsics(left, right)[0][3]
baseline = stored.getBaselineDistance(left, right)
print("depthai", dai.__version__, "calibrated 7.62 cm, drawn 7.5 cm")
print(f"getCameraExtrinsics {calibrated:.2f}, getBaselineDistance {baseline:.2f}")
assert abs(calibrated - 7.62) < 1e-5
assert abs(baseline - 7.5) < 1e-5
PYTHON
