"""Front ends and detectors of the caller's own: what is taken, what is refused, and what they
give.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio import Odometry, Parts, evaluate, load_config, open_dataset, run
from vio.cli import main
from vio.errors import ConfigError, DataError
from vio.frontend import FrontendSettings
from vio.frontend.detect import detect_corners, min_distance_px
from vio.frontend.given import as_frontend, build_given, load_given
from vio.frontend.given_corners import given_corners
from vio.frontend.klt import KltFrontend
from vio.frontend.patches import half_image
from vio.frontend.settings import GridSettings
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.guarded import guarded
from vio.protocols import Detector, Frontend
from vio.records import FrontendOutput, Image, Observations, StereoFrame, observations
from vio.testing import check_frontend

CAMERA = StereoCamera(fu=300.0, fv=300.0, cu=160.0, cv=100.0, baseline_m=0.1)
GRID = GridSettings(target_features=100)
IMAGE = np.random.default_rng(0).integers(0, 255, (200, 320), dtype=np.uint8)
_NONE = np.zeros((0, 2))


class Corners:
    """The built-in detector as one of the caller's own."""

    def __init__(self) -> None:
        self.calls = 0

    def detect(self, image: Image) -> FloatArray:
        self.calls += 1
        return detect_corners(half_image(image), _NONE, 1000, GridSettings())


class Fixed:
    """Finds what it is given."""

    def __init__(self, found: object) -> None:
        self.found = found

    def detect(self, image: Image) -> FloatArray:
        return self.found  # type: ignore[return-value]


def test_a_detector_is_made_a_front_end() -> None:
    assert isinstance(Corners(), Detector)
    assert isinstance(as_frontend(Corners(), CAMERA, FrontendSettings()), KltFrontend)
    own = KltFrontend(CAMERA)
    assert as_frontend(own, CAMERA, FrontendSettings()) is own


@pytest.mark.parametrize("effects", [(), ("blur", "noise")])
def test_a_detector_alone_is_checked_on_renders(effects: tuple[str, ...]) -> None:
    report = check_frontend(Corners, frames=12, effects=effects)
    assert report.features > 150
    assert report.matched > 0.8 * report.features
    assert report.survival > 0.9
    assert report.disparity_error_px < 0.15
    assert report.reused_ids == 0


def test_a_detector_takes_the_place_of_the_built_in_one_in_a_run(flight: Path) -> None:
    dataset = open_dataset(flight)
    mine = Corners()
    config = load_config(overrides=["motion=none"])
    result = run(dataset, config, parts=Parts(frontend=mine))
    assert 3 < mine.calls <= len(result.frames)
    truth = dataset.recording.reference
    assert truth is not None
    score = evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body)
    assert score.ate_m.rmse < 0.02


def test_corners_keep_their_order_their_distance_and_the_image() -> None:
    distance = min_distance_px(320, 200, GRID)
    best = [160.2, 100.4]
    found = np.array([[2.0, 2.0], best, [best[0] + 1, best[1]], [100.0, 100.0], [250.0, 50.0]])
    occupied = np.array([[100.0 + distance - 2, 100.0]])
    chosen = given_corners(Fixed(found), IMAGE, occupied, 50, GRID)
    np.testing.assert_array_equal(chosen, [best, [250.0, 50.0]])
    assert len(given_corners(Fixed(found), IMAGE, occupied, 1, GRID)) == 1
    allowed = np.zeros((100, 160), dtype=np.bool_)
    allowed[25, 125] = True
    masked = given_corners(Fixed(found), IMAGE, occupied, 50, GRID, allowed)
    np.testing.assert_array_equal(masked, [[250.0, 50.0]])


def test_no_cell_of_the_grid_takes_all_corners() -> None:
    crowd = np.random.default_rng(1).uniform([100, 60], [180, 140], (3000, 2))
    far = np.array([[30.0, 30.0], [290.0, 170.0]])
    chosen = given_corners(Fixed(np.concatenate([crowd, far])), IMAGE, _NONE, 100, GRID)
    assert {tuple(p) for p in far} <= {tuple(p) for p in chosen}
    assert len(chosen) < 100


def test_no_corner_is_asked_for_where_none_is_wanted() -> None:
    assert len(given_corners(Fixed("never asked"), IMAGE, _NONE, 0, GRID)) == 0


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ([[1.0, 2.0, 3.0]], r"\(1, 3\)"),
        (None, r"array \(\)|NoneType"),
        ("corners", "str"),
        ([[np.nan, 1.0]], "finite"),
        ([[50.0, 310.0]], "column, row"),
    ],
)
def test_what_a_detector_must_not_return(found: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        given_corners(Fixed(found), IMAGE, _NONE, 10, GRID)


class _WithoutMethod:
    pass


class _WithoutPrior:
    def process(self, frame: StereoFrame) -> FrontendOutput:
        raise AssertionError


class _OfTwo:
    def __init__(self, camera: StereoCamera, threshold: float) -> None:
        pass


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (_WithoutMethod, "_WithoutMethod is no front end and no detector"),
        (_WithoutPrior, r"process\(self, frame, prior=None\)"),
        (_OfTwo, "give the others defaults"),
        (lambda camera: Corners, "Corners is a class"),
        ("klt", "a str cannot be called"),
    ],
)
def test_the_bench_says_what_a_wrong_class_lacks(build: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_frontend(build, frames=2)  # type: ignore[arg-type]


class _Bare:
    """Returns observations without any count."""

    def __init__(self, camera: StereoCamera) -> None:
        self._klt = KltFrontend(camera)

    def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
        return FrontendOutput(self._klt.process(frame).observations)


def test_a_front_end_need_not_count() -> None:
    assert check_frontend(_Bare, frames=4).features > 100


def test_observations_of_another_kind_are_named() -> None:
    class Loose:
        def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
            return FrontendOutput([1, 2])  # type: ignore[arg-type]

    class OfAnother:
        def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
            return FrontendOutput(
                observations(frame.index + 1, frame.time_ns, [], np.zeros((0, 4)))
            )

    with pytest.raises(DataError, match=r"observations are a list; make them with"):
        check_frontend(Loose, frames=2)
    with pytest.raises(DataError, match="returned observations of frame 1 for frame 0"):
        check_frontend(OfAnother, frames=2)


_TEXT = """
from vio.frontend.detect import detect_corners
from vio.frontend.patches import half_image
from vio.frontend.settings import GridSettings
import numpy as np

class Mine:
    def detect(self, image):
        return detect_corners(half_image(image), np.zeros((0, 2)), 500, GridSettings())

number = 3
"""


def test_a_class_of_a_file_or_module_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_detector_file.py").write_text(_TEXT)
    (tmp_path / "my_detector_module.py").write_text(_TEXT)
    (tmp_path / "broken_detector.py").write_text("import no_such_package\n")
    monkeypatch.chdir(tmp_path)
    for text in ("my_detector_file.py:Mine", "my_detector_module:Mine"):
        made: Frontend = load_given(text, CAMERA, FrontendSettings())
        assert isinstance(made, KltFrontend)
    for text, message in (
        ("nowhere.py:Mine", "no such file"),
        ("my_detector_file.py:Yours", "has no Yours"),
        ("my_detector_file.py:number", "int cannot be called"),
        ("no_such_module_at_all:Mine", "working folder"),
        ("broken_detector.py:Mine", "no_such_package"),
        (":Mine", "FILE.py:CLASS"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_given(text, CAMERA, FrontendSettings())


def test_a_function_may_build_it() -> None:
    assert isinstance(build_given(lambda: Corners(), CAMERA), KltFrontend)
    assert isinstance(build_given(KltFrontend, CAMERA), KltFrontend)


def test_a_run_takes_a_detector_from_a_file(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_detector_of_a_run.py").write_text(_TEXT)
    own = f"{tmp_path / 'my_detector_of_a_run.py'}:Mine"
    arguments = ["--quiet", "--no-plot", "--stop", "8", "--out"]
    assert main(["run", str(flight), "--frontend", own, *arguments, str(tmp_path / "own")]) == 0
    assert main(["run", str(flight), *arguments, str(tmp_path / "built_in")]) == 0
    paths = [(tmp_path / name / "trajectory.tum").read_text() for name in ("own", "built_in")]
    assert paths[0] != paths[1], "other corners were used"
    assert (
        main(["run", str(flight), "--frontend", "nowhere.py:A", "--out", str(tmp_path / "x")]) == 1
    )
    assert "no such file" in capsys.readouterr().err


def test_a_detector_runs_live(flight: Path) -> None:
    """With the poses of the run to the bit."""
    dataset = open_dataset(flight)
    recording = dataset.recording
    config = load_config(overrides=["motion=none"])
    wanted = run(dataset, config, stop=8, parts=Parts(frontend=Corners()))
    parts = Parts(frontend=Corners())
    live = Odometry(recording.camera, config, T_cam0_imu=recording.T_cam0_imu, parts=parts)
    poses = []
    for frame in dataset.events(stop=8):
        if isinstance(frame, StereoFrame) and frame.left is not None and frame.right is not None:
            estimate = live.add_stereo(frame.time_ns, frame.left, frame.right)
            assert estimate is not None
            poses.append(estimate.T_world_imu)
    np.testing.assert_array_equal(poses, wanted.estimates.column("T_world_imu"))


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda seen: None, "returned a NoneType; it returns a FrontendOutput"),
        (lambda seen: seen, "returned a Observations; it returns a FrontendOutput"),
        (lambda seen: (seen.ids, seen.z), "returned a tuple; it returns a FrontendOutput"),
        (lambda seen: FrontendOutput(seen.z), "whose observations are a ndarray; make them with"),
        (
            lambda seen: FrontendOutput(replace(seen, frame_index=seen.frame_index + 1)),
            "returned observations of frame 1 for frame 0",
        ),
    ],
)
def test_a_run_says_what_a_front_end_must_return(
    returned: Callable[[Observations], FrontendOutput], message: str
) -> None:
    class Own:
        def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
            return returned(observations(frame.index, frame.time_ns, [1], [[9.0, 9, 8, 9]]))

    guard = guarded(Own(), CAMERA)
    with pytest.raises(DataError, match=rf"Own.process\(\) .*{message}"):
        guard.process(StereoFrame(0, 0, IMAGE, IMAGE))


def test_a_file_without_a_class_is_told_the_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = str(make_plain(tmp_path / "plain"))
    assert main(["run", recording, "--frontend", "own.py", "--out", str(tmp_path / "out")]) == 1
    assert "--frontend own.py: give FILE.py:CLASS" in capsys.readouterr().err
