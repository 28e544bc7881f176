#!/usr/bin/env bash
# DepthAI 3.12.0: of the functions of `ImgTransformation` that take a point of one camera to another, `projectPointTo` takes its depth in millimetres, as DepthAI's depth images have
# it, and `project3DPointTo`, `project3DPointFrom`, `remap3DPointTo` and `remap3DPointFrom` take centimetres: they add the translation of the extrinsics as it is stored, without a word
# of the unit. The same pixel at 1 m has a disparity of 60 px by the first and, as a point in millimetres, of 6 px by the others, as if the baseline were 7.5 mm.
# Guessed: one class, one unit: that of DepthAI's depth images and spatial coordinates, millimetres.
# Matters here: points of a depth image that are taken into another camera, or the IMU's frame, with these functions are off by nine tenths of the baseline, 68 mm here: colours
# and masks of the wrong places, and features of one camera beside those of the other. At 10 m that is 5 px of 6, at 100 m nothing: a test on far points passes.
# Source: DepthAI's texts of these functions: "(mm) Depth of the point to project" for the first, no unit for the others; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" depthai==3.12.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON' | grep -v " \[depthai\] " # what it says about USB
import depthai as dai

BASELINE_MM, FOCAL = 75.0, 800.0
INTRINSICS = [[FOCAL, 0.0, 320.0], [0.0, FOCAL, 200.0], [0.0, 0.0, 1.0]]


def camera(x_mm, unit):
    """A camera without distortion, x_mm to the right of the origin."""
    x = x_mm / {dai.LengthUnit.MILLIMETER: 1, dai.LengthUnit.CENTIMETER: 10}[unit]
    extrinsics = dai.Extrinsics()
    extrinsics.setTransformationMatrix([[1.0, 0, 0, x], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]], unit)
    extrinsics.toCameraSocket = dai.CameraBoardSocket.CAM_A
    return dai.ImgTransformation(640, 400, INTRINSICS, dai.CameraModel.Perspective, [0.0] * 14, extrinsics)


print("depthai", dai.__version__)
for unit in (dai.LengthUnit.CENTIMETER, dai.LengthUnit.MILLIMETER):
    left, right = camera(0.0, unit), camera(BASELINE_MM, unit)
    for depth_mm in (1000.0, 10000.0):
        point_mm, point_cm = dai.Point3f(0, 0, depth_mm), dai.Point3f(0, 0, depth_mm / 10)
        true = FOCAL * BASELINE_MM / depth_mm
        by_depth = 320 - left.projectPointTo(right, dai.Point2f(320, 200), depth_mm).x
        in_mm, in_cm = (320 - left.project3DPointTo(right, point).x for point in (point_mm, point_cm))
        back_mm = 320 - right.project3DPointFrom(left, point_mm).x
        moved = left.remap3DPointTo(right, point_mm)
        print(f"extrinsics set in {unit.name}, {depth_mm / 1000:.0f} m: disparity {true:.1f} px; by projectPointTo in mm {by_depth:.1f},")
        print(f"    by project3DPointTo in mm {in_mm:.1f}, in cm {in_cm:.1f} px; remap3DPointTo moves the point by {-moved.x:.1f} for {BASELINE_MM:.0f} mm")
        assert abs(by_depth - true) < 1e-3 and abs(in_cm - true) < 1e-3
        assert abs(in_mm - true / 10) < 1e-3 and abs(back_mm - in_mm) < 1e-3
        assert abs(moved.x + BASELINE_MM / 10) < 1e-3
PYTHON
