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
            "; disparities off by as much would cost 2.5 m per 100 m",
        ),
        (
            StereoError(0.05, 20.0, -0.02, 0.01),
            "negligible",
            "disparities by -0.02 ± 0.01 px, which costs 0.1 ± 0.05 m",
        ),
        (
            StereoError(0.05, 20.0, -0.08, 0.03),
            "negligible",
            "by -0.08 ± 0.03 px, which costs 0.4 ± 0.15 m",
        ),
        (
            StereoError(0.05, 20.0, 0.5, 0.01),
            "worth calibrating",
            "by +0.50 ± 0.01 px, which costs 2.5 ± 0.05 m per 100 m",
        ),
        (
            StereoError(0.05, 20.0, 3.0),
            "unusable",
            "disparities by +3.00 px, which costs 15 m per 100 m",
        ),
        (StereoError(0.05, 2.0, 3.84, 0.68), "unusable", "which costs 190 ± 34 m per 100 m"),
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
