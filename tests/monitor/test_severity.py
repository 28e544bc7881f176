"""One grade and one wording of a stereo calibration that is off, for all commands."""

from __future__ import annotations

import pytest

from vio.calibration.severity import Grade, StereoError, length_grade, rows_grade


@pytest.mark.parametrize(
    ("error", "grade", "text"),
    [
        (StereoError(0.04, 20.0), "negligible", "negligible: rows off by 0.04 px (rms)"),
        (
            StereoError(0.41, 16.4),
            "worth calibrating",
            "worth calibrating: rows off by 0.41 px (rms)",
        ),
        (
            StereoError(0.05, 20.0, -0.02, 0.01),
            "negligible",
            "disparities by -0.02 ± 0.01 px, and so lengths by 0.100 ± 0.050 %",
        ),
        (
            StereoError(0.05, 20.0, -0.08, 0.03),
            "negligible",
            "by -0.08 ± 0.03 px, and so lengths by 0.40 ± 0.15 %",
        ),
        (
            StereoError(0.05, 20.0, 0.5, 0.01),
            "worth calibrating",
            "by +0.50 ± 0.01 px, and so lengths by 2.500 ± 0.050 %",
        ),
        (
            StereoError(0.05, 20.0, 3.0),
            "unusable",
            "disparities by +3.00 px, and so lengths by 15 %",
        ),
        (StereoError(0.05, 2.0, 3.84, 0.68), "unusable", "lengths by 192 ± 34 %"),
        (
            StereoError(4.0, 20.0, 0.0, 0.01),
            "unusable",
            "unusable: rows off by 4.00 px (rms), disparities by +0.00",
        ),
        (StereoError(0.1, -20.0), "unusable", "most disparities are negative"),
        (
            StereoError(0.3, 0.0),
            "worth calibrating",
            "worth calibrating: rows off by 0.30 px (rms)",
        ),
    ],
)
def test_the_worse_of_rows_and_lengths_decides(error: StereoError, grade: Grade, text: str) -> None:
    assert error.grade == grade
    assert str(error).startswith(f"{grade}: ")
    assert text in str(error)


def test_grades_grow_with_the_size() -> None:
    assert [rows_grade(px) for px in (0.15, 0.16, 2.0, 2.1)] == [
        "negligible",
        *["worth calibrating"] * 2,
        "unusable",
    ]
    assert [length_grade(m) for m in (0.1, 1.0, 11.0)] == [
        "negligible",
        "worth calibrating",
        "unusable",
    ]
