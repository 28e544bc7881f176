"""Stereo fields of one rig, compared by their stated covariances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.commands import json_of
from tests.dataset_makers import make_drive, make_mat, utias_arrays
from vio.bench.reverse import Reversed
from vio.bench.rigs import agreement_lines, agreements
from vio.bench.suite import suite_from
from vio.bench.tables import Outcome
from vio.datasets import open_dataset
from vio.evaluation.field_agreement import (
    DisparityField,
    disparity_error,
    disparity_field,
    field_difference,
)
from vio.geometry.stereo import StereoCamera
from vio.records import StereoFieldEstimate, StereoFrame


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Features of a drive with ground truth, exact but for their noise."""
    path = tmp_path_factory.mktemp("recordings") / "drive.mat"
    make_mat(path, utias_arrays(make_drive(20, pixel_sigma=0.3)))
    return path


CAMERA = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5, 1200, 370)


def _field(shift_px: float, sigma_px: float, camera: StereoCamera = CAMERA) -> DisparityField:
    coefficients = np.zeros(8)
    coefficients[0] = shift_px / camera.fu
    covariance = np.diag([sigma_px / camera.fu, *[1e-9] * 7]) ** 2
    found = disparity_field(camera, StereoFieldEstimate(coefficients, covariance))
    assert found is not None
    return found


def test_a_shift_of_right_columns_is_the_same_all_over_the_image() -> None:
    field = _field(1.5, 0.1)
    px, jacobian = disparity_error(field, field.places())
    np.testing.assert_allclose(px, -1.5)
    difference = field_difference(field, _field(1.0, 0.1))
    assert difference is not None
    assert difference.rms_px == pytest.approx(0.5)
    assert difference.sigma_px == pytest.approx(0.1 * np.sqrt(2))
    assert difference.nees == pytest.approx(0.5**2 / (2 * 0.1**2))
    assert jacobian.shape == (18, 10)


def test_fields_drawn_from_their_covariance_have_a_nees_of_one() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 8)) * 1e-4
    rows = rng.normal(size=(7, 7)) * 1e-4

    def drawn() -> DisparityField:
        found = disparity_field(
            CAMERA,
            StereoFieldEstimate(
                root @ rng.normal(size=8),
                root @ root.T,
                0.1,
                rows @ rng.normal(size=7),
                rows @ rows.T,
            ),
        )
        assert found is not None
        return found

    values = [field_difference(drawn(), drawn()) for _ in range(400)]
    nees = [value.nees for value in values if value is not None]
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * np.std(nees) / np.sqrt(len(nees)))


def test_cameras_of_other_images_are_not_compared_and_a_size_may_be_unknown() -> None:
    other = StereoCamera(650.0, 650.0, 600.0, 180.0, 0.5, 1200, 370)
    assert field_difference(_field(0, 0.1), _field(0, 0.1, other)) is None
    features = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5)
    difference = field_difference(_field(0, 0.1, features), _field(0.2, 0.1))
    assert difference is not None
    assert difference.rms_px == pytest.approx(0.2)
    cylinder = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5, 1200, 370, projection="cylinder")
    assert disparity_field(cylinder, StereoFieldEstimate(np.zeros(8), np.eye(8))) is None


def test_pairs_that_differ_in_one_thing_are_compared(tmp_path: Path) -> None:
    values = {
        "sequences": {
            "a": {"source": "one", "rig": "r"},
            "a.back": {"source": "one", "rig": "r", "reverse": True},
            "b": {"source": "two", "rig": "r"},
            "c": {"source": "three", "rig": "other"},
            "d": "four",
        },
        "configurations": {"x": {}, "y": {"msckf.stereo_yaw_sigma_deg": 0.1}},
    }
    suite = suite_from(values, tmp_path / "s.yaml")
    outcomes = [
        Outcome(
            s.name,
            system,
            0,
            "",
            {},
            {},
            None,
            None,
            rig=s.rig,
            stereo_field=_field(k, 1).as_dict(),
        )
        for system in suite.configurations
        for k, s in enumerate(suite.sequences)
    ]
    found = agreements(suite, outcomes)
    assert [(one.rig, one.kind, one.runs) for one in found] == [
        ("r", "backward", ("a, x", "a.back, x")),
        ("r", "another drive", ("a, x", "b, x")),
        ("r", "another configuration", ("a, x", "a, y")),
        ("r", "another configuration", ("b, x", "b, y")),
        ("other", "another configuration", ("c, x", "c, y")),
    ]
    assert found[1].difference.nees == pytest.approx(2.0)
    assert "| r | another drive | 1 | 2 | 1.4 | 2 | 2 |" in agreement_lines(found)


def test_a_recording_is_played_backward(drive: Path) -> None:
    source = open_dataset(drive)
    backward = Reversed(source, 1, 5)
    times_ns = source.recording.frame_times_ns
    own = backward.recording
    np.testing.assert_array_equal(own.frame_times_ns, times_ns[1] + times_ns[4] - times_ns[4:0:-1])
    frames = [event for event in backward.events() if isinstance(event, StereoFrame)]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    forward = {e.index: e for e in source.events() if isinstance(e, StereoFrame)}
    for frame, k in zip(frames, (4, 3, 2, 1), strict=True):
        assert frame.time_ns == own.frame_times_ns[frame.index]
        assert forward[k].index == k
        seen = backward.observations(frame.index)
        same = source.observations(k)
        assert seen is not None
        assert same is not None
        assert (seen.frame_index, seen.time_ns) == (frame.index, frame.time_ns)
        np.testing.assert_array_equal(seen.z, same.z)
    assert own.reference is not None
    assert source.recording.reference is not None
    truth = source.recording.reference.numbered()
    rows = [list(truth.frame_indices).index(k) for k in (4, 3, 2, 1)]  # type: ignore[arg-type]
    np.testing.assert_array_equal(own.reference.T_world_body, truth.T_world_body[rows])
    np.testing.assert_array_equal(own.reference.frame_indices, [0, 1, 2, 3])
    assert own.motion == frozenset()


def test_a_suite_gives_the_table_of_its_rigs(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "rigs.yaml"
    suite.write_text(
        f"""
sequences:
  forward: {{source: {drive.name}, rig: r}}
  backward: {{source: {drive.name}, rig: r, reverse: true}}
configurations: {{images: {{motion: none}}}}
"""
    )
    out = tmp_path / "out"
    folders: list[str | Path] = [
        "--data",
        drive.parent,
        "--out",
        out,
        "--cache",
        tmp_path / "cache",
    ]
    facts = json_of(capsys, "bench", suite, *folders, "--workers", "1", "--quiet")
    (one,) = facts["rigs"]
    assert one["kind"] == "backward"
    assert one["difference"]["nees"] < 3
    assert "Stereo fields of one rig" in (out / "tables.md").read_text()
    ate_m = [outcome["figures"]["ate_m"] for outcome in facts["outcomes"]]
    assert max(ate_m) < 0.5
