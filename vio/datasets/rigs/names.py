"""Names of calibration files."""

from __future__ import annotations

from pathlib import Path

from vio.datasets.rigs.bare import NAMES

# File names looked for in a folder, in this order; the content decides what they are.
_IN_FOLDER = (
    "calibration.yaml", "calibration.yml", "camchain-imucam*.yaml", "*camchain-imucam*.yaml", "camchain*.yaml",
    "*camchain*.yaml", "*imucam_chain*.y*ml", "calib_cam_to_cam.txt", "perspective.txt", "calib.txt", "left.y*ml",
    "stereo*.y*ml", "intrinsics.y*ml", "stereo*.xml", "calibration.xml", "calib.xml", "calib.y*ml",
    "calibration.json", "calib.json", "SN*.conf", "undistorted_calib_0.txt", *NAMES,
)  # fmt: skip


def named_calibration(folder: Path) -> Path | None:
    """Return the calibration file of a folder by the usual names; None where there is none."""
    for mav in (folder / "mav0", folder):
        if (mav / "cam0" / "sensor.yaml").is_file():
            return mav / "cam0" / "sensor.yaml"
    for pattern in _IN_FOLDER:
        if found := sorted(file for file in folder.glob(pattern) if file.is_file()):
            return found[0]
    return None
