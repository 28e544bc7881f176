"""Each limit of what a run says while it works, and of what is drawn of it, from both sides."""

from __future__ import annotations

import re
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from vio import cli
from vio.cli.evaluate import _side_by_side
from vio.cli.running import _stereo_rows, metric_rows
from vio.cli.waiting import line_due
from vio.errors import DataError, VioError
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, StereoFrame, observations
from vio.report.compared import _change, apart
from vio.report.figures import _equal_scales, _fit_bands
from vio.runs import folder, picture, pipeline
from vio.runs.checkpoint import _changes
from vio.runs.pipeline import _unread_line
from vio.runs.recorder import RunRecorder
from vio.view.annotated import AnnotatedImage
from vio.view.live import RerunViewer, ViewedRig, age_colours
from vio.view.stream import open_stream

Says = Callable[[float], bool]


def _slow(times: float) -> bool:
    """Whether one frame of a hundred, of so many times the usual time, is counted as slow."""
    work = np.full(100, 10.0)
    work[3] = 10.0 * times
    return folder.start_s(work) > 0.0


def _finished(frames: int) -> Any:
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, 3] = np.random.default_rng(0).normal(size=(frames, 3))
    return SimpleNamespace(
        metrics={"source": "a", "body": "cam0"},
        estimates={"time_ns": np.arange(frames), "T_world_imu": T},
        seconds=np.arange(frames) * 0.1,
    )


def _fits_in(address_space: float) -> bool:
    with patch.object(resource, "getrlimit", lambda kind: (round(address_space), -1)):
        try:
            cli._check_address_space("run")
        except VioError:
            return False
    return True


def _path_is_cut(letters: int) -> bool:
    return "a" * letters not in cli._message(FileNotFoundError(2, "no file", "a" * letters))


def _name_is_cut(letters: int) -> bool:
    none: Any = SimpleNamespace(rmse=0.1)
    result: Any = SimpleNamespace(
        ate_m=none, ate_deg=none, rpe=None, matched=1, scale_free=None, kitti=None
    )
    result.as_dict = lambda: {"t_err_percent": None}
    names = [text for _, text in _side_by_side({"a" * letters: result})]
    return "…" in names[1]


def _says_that_loops_compile(start_s: float) -> bool:
    metrics: Any = MagicMock()
    figures = {"start_s": start_s, "stages_ms": {}, "frames": 9, "last_frame": 8, "first_frame": 0}
    figures |= dict.fromkeys(("refused_share", "stereo_field"))
    figures |= dict.fromkeys(("path_length_m", "ms_per_frame_median", "ms_per_frame_95"), 1.0)
    figures |= {"evaluation": None, "body": "cam0", "backend": "", "motion": "", "out": "a"}
    metrics.__getitem__.side_effect = figures.__getitem__
    metrics.get.side_effect = lambda name, default=None: figures.get(name, default)
    with (
        patch("vio.cli.running._scale_rows", lambda m: []),
        patch("vio.cli.running._calibration_rows", lambda m: []),
        patch("vio.cli.running._map_rows", lambda m: []),
        patch("vio.cli.running._error_rows", lambda m: []),
    ):
        return any("compiled" in text for _, text in metric_rows(metrics, plot=False))


def _all_lines(count: int) -> bool:
    rig = {"lines": [str(k) for k in range(count)]}
    return len(_stereo_rows({"stereo_field": {"text": "", "rig": rig}})) == 1 + count


def _changed(count: int) -> str:
    return _changes({str(k): 0 for k in range(count)}, {})


def _is_save_due(after_s: float) -> bool:
    recorder = SimpleNamespace(can_save=True, _saved_s=time.monotonic() - after_s)
    due: Any = RunRecorder.is_save_due
    return bool(due.fget(recorder))


def _gives_up(refused: int) -> bool:
    """Whether a run ends where the front end has refused so many frames, and taken one less."""
    pass_: Any = MagicMock()
    pass_._state.processor.pipeline.monitor.frames_refused = refused
    pass_._state.frame_ns = None
    pass_._state.unread = []
    pass_._recorder.__len__.return_value = refused - 1
    pass_._recorder.is_save_due = False
    reads = iter([SimpleNamespace(samples=[], frame=None, ms=0.0)] * 3)
    with patch.object(pipeline, "_read", lambda events: reads):
        try:
            pipeline._Loop.run(pass_, [], MagicMock(), lambda: None)
        except DataError:  # most frames were refused
            return len(list(reads)) > 0
    return False


def _axes() -> Any:
    return Figure().add_subplot()


def _has_calibration(sigmas: float) -> bool:
    field = SimpleNamespace(coefficients=np.array([0.0, sigmas]), covariance=np.eye(2))
    result: Any = SimpleNamespace(estimates=[SimpleNamespace(stereo_field=field)])
    return picture.has_calibration_panel(result)


def _band() -> float:
    """The half width of the band about a height, in standard deviations."""
    axes = _axes()
    curves: Any = SimpleNamespace(
        position=np.zeros((3, 3)), position_sigma=np.ones((3, 3)), truth=None, seconds=np.arange(3)
    )
    picture._draw_height(axes, curves)
    return float(axes.collections[0].get_paths()[0].vertices[:, 1].max())


def _seen_of_a_rig_that_stands() -> float:
    low, high = picture._view(np.zeros((5, 2)), 1.0)
    return float((high - low)[0])


def _is_in_millimetres(error_m: float) -> bool:
    axes = _axes()
    errors = np.array([0.0, error_m])
    truth = SimpleNamespace(positions=np.zeros((2, 3)), times_ns=None)
    picture._compare_curves(
        axes, {"a": SimpleNamespace(errors_m=errors, reference=truth)}, "position", "distance"
    )
    return "mm" in axes.get_ylabel()


def _end_of_axis() -> float:
    axes = _axes()
    truth = SimpleNamespace(seconds=np.arange(2), error_m=np.array([0.0, 1.0]))
    picture._draw_error(axes, SimpleNamespace(truth=truth), None)  # type: ignore[arg-type]
    return float(axes.get_ylim()[1])


def _is_thinned(frames: int) -> bool:
    axes = _axes()
    counts = {name: np.ones(frames) for name in ("selected", "matched", "used")}
    picture._draw_counts(axes, np.arange(frames), counts)  # type: ignore[arg-type]
    return len(axes.lines[0].get_xdata()) < frames


def _longest_side() -> float:
    ratio = _equal_scales(np.array([1.0, 3.0, 2.0]))["aspectratio"]
    return float(max(ratio.values()))


def _shows_edge(percent: float) -> bool:
    """Whether an axis shows the edges of a band that so many percent of them are beyond."""
    edges = np.zeros(1000)
    edges[: round(10.0 * percent)] = 5.0
    traces = [SimpleNamespace(fill="toself", y=edges), SimpleNamespace(fill=None, y=[0.0, 1.0])]
    figure = MagicMock()
    figure.select_traces.return_value = traces
    _fit_bands(figure, 1, 1)
    return bool(figure.update_yaxes.call_args.kwargs["range"][1] > 2.0)


def _annotated(width: int) -> np.ndarray[Any, Any]:
    view = AnnotatedImage(1)
    left = np.random.default_rng(0).integers(0, 255, (60, width), dtype=np.uint8)
    nothing = observations(0, 0, [], np.zeros((0, 4)), [])
    frame = StereoFrame(0, 0, left, left)
    result: Any = SimpleNamespace(frame=frame, output=SimpleNamespace(observations=nothing))
    view.frame(result)
    return np.frombuffer(view.jpeg() or b"", np.uint8)


def _annotated_size(width: int) -> tuple[int, ...]:
    return cv2.imdecode(_annotated(width), cv2.IMREAD_COLOR).shape


CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def _viewer(camera: StereoCamera = CAMERA) -> Any:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    return RerunViewer(MagicMock(), ViewedRig(camera, np.eye(4), None, None))


def _draws_image(share: float) -> bool:
    """Whether an image is drawn where drawing took so much of the time."""
    viewer = _viewer()
    viewer._spent_s = 100.0
    viewer._began_s = time.perf_counter() - 100.0 / share
    viewer._image = MagicMock()
    viewer._pose = viewer._numbers = lambda *_: None
    viewer.show(0, Estimate(0, np.eye(4), np.eye(6)), {}, np.zeros((4, 4), np.uint8))
    return bool(viewer._image.called)


def _tail(frames: int) -> int:
    viewer = _viewer()
    for k in range(frames):
        viewer._follow(observations(k, k, [7], [[k, 0, k - 1, 0]], [True]))
    return len(viewer._tails[7])


def _draws_point(disparity_px: float) -> bool:
    viewer = _viewer()
    seen = observations(0, 0, [7], [[100, 100, 100 - disparity_px, 100]], [True])
    with patch("rerun.Points3D") as points:
        viewer._points(seen, Estimate(0, np.eye(4), np.eye(6)))
    return len(points.call_args.args[0]) > 0


def _drawn_sigmas() -> float:
    viewer = _viewer()
    with patch("rerun.Ellipsoids3D") as ellipsoids:
        viewer._pose(Estimate(0, np.eye(4), np.eye(6)))
    return float(ellipsoids.call_args.kwargs["half_sizes"][0][0])


def _bytes_of_image() -> int:
    """Of noise, which is the more the better its JPEG is."""
    viewer = _viewer()
    noise = np.random.default_rng(0).integers(0, 255, (100, 100), dtype=np.uint8)
    with patch("rerun.EncodedImage") as image:
        viewer._image(noise)
    return len(image.call_args.kwargs["contents"])


def _is_as_old_as_any(frames: int) -> bool:
    colours = age_colours(np.array([frames, 10_000]))
    return bool((colours[0] == colours[1]).all())


def _wide(width: int) -> StereoCamera:
    return StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, width, 480)


def _outline_baselines() -> float:
    """How far away the middle of the image of a cylinder camera is drawn."""
    camera = replace(CAMERA, projection="cylinder")
    with patch("rerun.LineStrips3D") as lines:
        _viewer(camera)
    border = lines.call_args.args[0][0]
    depth = np.hypot(border[:, 1], border[:, 2])
    return float(depth.min()) / camera.baseline_m


def test_a_browser_is_led_to_reruns_usual_port() -> None:
    rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    usual = re.search(r"defaults to (\d+)", rr.serve_web_viewer.__doc__ or "")
    assert usual
    with patch("rerun.serve_web_viewer") as serve, patch("rerun.RecordingStream") as stream:
        stream.return_value.serve_grpc.return_value = "a"
        address = open_stream("web", "a")[1]
    assert str(serve.call_args.kwargs["web_port"]) == usual[1]
    assert f":{usual[1]}/" in str(address)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "line: at first": (lambda x: line_due(0.0, x), 4.5, 5.5),
    "line: later": (lambda x: line_due(100.0, x), 18.0, 22.0),
    "line: at most": (lambda x: line_due(1e4, x), 27.0, 33.0),
    "frames: slow": (_slow, 9.0, 11.0),
    "summary: address space": (_fits_in, 0.9e9, 1.1e9),
    "summary: path": (lambda n: _path_is_cut(int(n)), 200, 201),
    "summary: name": (lambda n: _name_is_cut(int(n)), 32, 33),
    "summary: compiled": (_says_that_loops_compile, 0.9, 1.1),
    "summary: lines of a calibration": (lambda n: not _all_lines(int(n)), 3, 4),
    "resume: changes": (lambda n: "more" in _changed(int(n)), 3, 4),
    "resume: unread frames": (lambda n: "…" in _unread_line(list(range(int(n))), 9), 5, 6),
    "run: refused frames": (lambda n: _gives_up(int(n)), 9, 10),
    "checkpoint: time": (_is_save_due, 4.5, 5.5),
    "picture: calibration": (_has_calibration, 2.7, 3.3),
    "picture: band": (lambda x: _band() < x, 2.7, 3.3),
    "picture: stands": (lambda x: _seen_of_a_rig_that_stands() < x, 0.036, 0.044),
    "picture: millimetres": (lambda x: not _is_in_millimetres(x), 0.018, 0.022),
    "picture: headroom": (lambda x: _end_of_axis() < x, 1.2, 1.4),
    "picture: medians": (lambda n: _is_thinned(int(n)), 250, 251),
    "page: the same": (lambda x: _change(100.0, 100.0 + x) != " (the same)", 0.45, 0.55),
    "page: bulk": (_shows_edge, 9.0, 11.0),
    "page: box": (lambda x: _longest_side() < x, 1.4, 1.6),
    "annotated: width": (lambda n: _annotated_size(int(n))[1] < n, 1240, 1241),
    "annotated: legend": (lambda n: _annotated_size(int(n))[0] > 60, 479, 480),
    "annotated: bar": (lambda n: _annotated_size(600)[0] - 60 < n, 26, 27),
    "annotated: bytes": (lambda n: len(_annotated(400)) < n, 16_000, 21_000),
    "viewer: width": (lambda n: _viewer(_wide(int(n)))._scale < 1.0, 752, 753),
    "viewer: time": (lambda x: not _draws_image(x), 0.07, 0.09),
    "viewer: tail": (lambda n: _tail(int(n)) < n, 12, 13),
    "viewer: disparity": (_draws_point, 2.7, 3.3),
    "viewer: sigmas": (lambda x: _drawn_sigmas() < x, 2.7, 3.3),
    "viewer: outline": (lambda x: _outline_baselines() < x, 4.5, 5.5),
    "viewer: old": (lambda n: _is_as_old_as_any(int(n)), 38, 40),
    "viewer: bytes": (lambda n: _bytes_of_image() < n, 5_500, 7_500),
    "compared: frames": (
        lambda n: apart(_finished(int(n)), _finished(int(n))) is not None,
        2,
        3,
    ),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_runs(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
