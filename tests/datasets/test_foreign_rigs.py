"""Calibrations of other tools, against the rig that they state in another form."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import vio
from tests import calibration_forms as forms
from tests.calibration_forms import FORMS, Form, table
from vio.cameras.rig import Rig
from vio.errors import CalibrationError

ROOT = Path(__file__).parents[2]
BEGIN = "<!-- table of formats, by tests.calibration_forms -->"


def _close(found: Rig, truth: Rig) -> None:
    for a, b in zip(found.cameras, truth.cameras, strict=True):
        assert (a.model, a.width, a.height) == (b.model, b.width, b.height)
        pixels = [[c.fu, c.fv, c.cu, c.cv] for c in (a, b)]
        np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-9)
        count = max(len(a.coefficients), len(b.coefficients))
        bends = [[*c.coefficients, *[0.0] * 8][:count] for c in (a, b)]
        np.testing.assert_allclose(bends[0], bends[1], atol=1e-12)
    np.testing.assert_allclose(found.right[1], truth.right[1], atol=1e-9)
    assert (found.T_cam0_imu is None) == (truth.T_cam0_imu is None)
    if truth.T_cam0_imu is not None and found.T_cam0_imu is not None:
        np.testing.assert_allclose(found.T_cam0_imu, truth.T_cam0_imu, atol=1e-9)
    assert (found.imu_noise is None) == (truth.imu_noise is None)
    if truth.imu_noise is not None and found.imu_noise is not None:
        for name in ("gyro", "gyro_walk", "accel", "accel_walk"):
            assert getattr(found.imu_noise, name) == pytest.approx(getattr(truth.imu_noise, name))
    assert found.time_offset_s == pytest.approx(truth.time_offset_s, abs=1e-12)


@pytest.mark.parametrize("form", [f for f in FORMS if f.truth], ids=lambda f: f"{f.name} {f.files}")
def test_every_form_of_a_rig_is_read_as_that_rig(form: Form, tmp_path: Path) -> None:
    rig = vio.load_rig(form.write(tmp_path), image_size=form.known_size)
    assert form.truth is not None
    _close(rig, form.truth)


# a form, and what its file calls the lens
UNKNOWN_LENSES: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "Kalibr": (forms.kalibr, "camera_model: pinhole", "camera_model: trioptar"),
    "Kalibr's distortion": (forms.kalibr, "model: radtan", "model: trioptar"),
    "OpenVINS": (forms.openvins, "model: radtan", "model: trioptar"),
    "Kimera": (forms.kimera, "camera_model: pinhole", "camera_model: trioptar"),
    "Kimera's distortion": (forms.kimera, "radial-tangential", "trioptar"),
    "camodocal": (lambda f: forms.vins("radtan", f), "PINHOLE", "TRIOPTAR"),
    "camodocal's SCARAMUZZA": (lambda f: forms.vins("radtan", f), "PINHOLE", "SCARAMUZZA"),
    "ORB-SLAM3": (lambda f: forms.orbslam3("radtan", f), '"PinHole"', '"Trioptar"'),
    "Basalt": (lambda f: forms.basalt("eucm", f), '"eucm"', '"trioptar"'),
    "Monado": (forms.monado, "pinhole_radtan5", "trioptar"),
    "DepthAI": (forms.depthai, '"cameraType": 0', '"cameraType": 77'),
    "OKVIS": (forms.okvis, "type: radialtangential", "type: trioptar"),
    "OKVIS2": (forms.okvis2_eucm, "cam_model: eucm", "cam_model: trioptar"),
    "SVO": (forms.ncamera, "type: pinhole", "type: trioptar"),
    "SVO's distortion": (forms.ncamera, "type: radial-tangential", "type: trioptar"),
}


@pytest.mark.parametrize("tool", UNKNOWN_LENSES)
def test_a_lens_that_is_not_known_is_refused_by_its_name(tool: str, tmp_path: Path) -> None:
    write, known, other = UNKNOWN_LENSES[tool]
    path = write(tmp_path)
    changed = 0
    for file in tmp_path.iterdir():
        text = file.read_text()
        changed += known in text
        file.write_text(text.replace(known, other))
    assert changed
    name = other.split(": ")[-1].strip('"')
    with pytest.raises(CalibrationError, match=f"(?i){name}.* not (read|supported)") as found:
        vio.load_rig(path)
    assert "\n" not in str(found.value)


def test_table_of_formats_is_what_the_readers_do() -> None:
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    assert table() == page.split(BEGIN)[1].split("<!-- end -->")[0].strip()
