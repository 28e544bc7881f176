"""A test bench for front ends: rendered images in which the true match of every pixel is known.

```python
from vio.testing import check_frontend

report = check_frontend(MyFrontend)  # called with the camera; has process(frame, prior)
assert report.survival > 0.9
assert report.disparity_error_px < 0.3
```

A detector alone, with `detect(image)`, is taken as well: `klt` tracks and matches its corners.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import FloatArray
from vio.protocols import Detector, Frontend
from vio.records import Observations, StereoFrame, shared_rows
from vio.sim.render import View, correspondence, inside_image
from vio.sim.scenarios import Scenario, conditions_of, plan
from vio.sim.sequence import SimulatedRecording, Simulation, views

_CORRECT_PX = 1.0  # largest error of a feature that follows its point
_MARGIN_PX = 12.0  # points closer to the border need not be followed


@dataclass(frozen=True, slots=True)
class FrontendReport:
    """How well a front end follows points and finds them in the right image, in pixels."""

    frames: int
    features: float  # median number in a frame
    matched: float  # median number with a right match
    # share of features, visible in the next frame too, that are followed there within 1 px
    survival: float
    wrong: float  # share of followed features that are off by more than 1 px
    step_error_px: float  # median error of a step to the next frame, of those within 1 px
    step_bias_px: tuple[float, float]  # their median error in u and v: a bias becomes drift
    disparity_error_px: float  # median error of disparities within 1 px
    disparity_bias_px: float  # their signed median: a bias becomes an error of scale
    wrong_matches: float  # share of right matches that are off by more than 1 px
    row_error_px: float  # median difference of rows to the true ones
    reused_ids: int  # ids that came back after their feature was lost; must be 0

    def __str__(self) -> str:
        return "\n".join(f"{f.name:<20} {_shown(getattr(self, f.name))}" for f in fields(self))


@dataclass(slots=True)
class FrontendErrors:
    """Errors of a front end, one array a frame, pixels."""

    step: list[FloatArray] = field(default_factory=list)  # (N, 2)
    right: list[FloatArray] = field(default_factory=list)  # (N, 2)
    features: list[int] = field(default_factory=list)
    matched: list[int] = field(default_factory=list)
    visible: int = 0  # features whose point is visible in the next frame
    followed: int = 0  # of these, followed within `_CORRECT_PX`
    lost: set[int] = field(default_factory=set)
    reused: int = 0


def check_frontend(
    build: Callable[..., Frontend | Detector],
    *,
    frames: int = 40,
    width: int = 320,
    scene: Literal["room", "street", "corridor"] = "room",
    effects: Sequence[str] = (),
    seed: int = 0,
) -> FrontendReport:
    """Run a front end over rendered images and compare what it finds with the truth; a few seconds.

    Args:
        build: a class or function, called with the rectified camera (with nothing, where it takes
            no argument); returns a front end, or a detector, whose corners `klt` tracks.
        frames: at 20 Hz along a hand-held flight (`room`, `corridor`), at 10 Hz along a drive
            (`street`).
        width: of the images, pixels.
        scene: what is rendered.
        effects: names of `vio render --effects`, such as blur, noise, dark, moving.
        seed: of scene, motion and noise.

    Raises:
        VioError: an argument is invalid, or what `build` returns is no front end and no detector.
        DataError: the front end returned something else than observations of the frame that it was
            given.
    """
    from vio.frontend.given import build_given  # it loads OpenCV

    rate_hz = 10.0 if scene == "street" else 20.0
    scenario = Scenario(
        scene=scene,
        trajectory="car" if scene == "street" else "handheld",
        rig="kitti" if scene == "street" else "euroc-rectified",
        width=width,
        rate_hz=rate_hz,
        duration_s=frames / rate_hz,
        conditions=conditions_of(effects),
        seed=seed,
    )
    simulation = plan(scenario)
    recording = SimulatedRecording(simulation)
    frontend = build_given(build, rectified_camera(simulation.rig))
    errors = FrontendErrors()
    before: Observations | None = None
    for frame in recording.events():
        if isinstance(frame, StereoFrame):
            now = _process(frontend, frame)
            compare(errors, simulation, before, now)
            before = now
    return _report(errors)


def _process(frontend: Frontend, frame: StereoFrame) -> Observations:
    """Return the fresh observations of a frame."""
    from vio.frontend.given import checked_output

    found = checked_output(frontend, frontend.process(frame), frame).observations
    return found.take(~found.stale)


def compare(
    errors: FrontendErrors, simulation: Simulation, before: Observations | None, now: Observations
) -> None:
    """Add the errors of a frame's fresh observations, and of the step from those of the frame
    before.
    """
    left, right = _views(simulation, now)
    seen = now.take(now.has_right)
    true, visible = correspondence(simulation.world, left, right, seen.z[:, :2])
    errors.right.append((seen.z[:, 2:] - true)[visible])
    errors.features.append(len(now))
    errors.matched.append(len(seen))
    errors.reused += sum(name in errors.lost for name in now.ids.tolist())
    if before is None:
        return
    true, visible = correspondence(
        simulation.world, _views(simulation, before)[0], left, before.z[:, :2]
    )
    i, j = shared_rows(before.ids, now.ids)
    error = now.z[j, :2] - true[i]
    expected = visible & inside_image(left.camera, true, margin_px=_MARGIN_PX)
    errors.step.append(error[visible[i]])
    errors.visible += int(expected.sum())
    errors.followed += int((expected[i] & (np.linalg.norm(error, axis=1) <= _CORRECT_PX)).sum())
    errors.lost |= set(before.ids.tolist()) - set(now.ids.tolist())


def _views(simulation: Simulation, seen: Observations) -> tuple[View, View]:
    return views(simulation, int(simulation.taken_ns[seen.frame_index]))


def _report(errors: FrontendErrors) -> FrontendReport:
    step, right = (
        np.concatenate(part) if part else np.zeros((0, 2)) for part in (errors.step, errors.right)
    )
    good_step, good_right = (
        part[np.linalg.norm(part, axis=1) <= _CORRECT_PX] for part in (step, right)
    )
    wrong = 0.0
    if len(step):
        wrong = 1 - len(good_step) / len(step)
    wrong_matches = 0.0
    if len(right):
        wrong_matches = 1 - len(good_right) / len(right)
    return FrontendReport(
        frames=len(errors.features),
        features=float(np.median(errors.features)),
        matched=float(np.median(errors.matched)),
        survival=errors.followed / max(errors.visible, 1),
        wrong=wrong,
        step_error_px=_median(np.linalg.norm(good_step, axis=1)),
        step_bias_px=(_median(good_step[:, 0]), _median(good_step[:, 1])),
        disparity_error_px=_median(np.abs(good_right[:, 0])),
        disparity_bias_px=_median(-good_right[:, 0]),
        wrong_matches=wrong_matches,
        row_error_px=_median(np.abs(good_right[:, 1])),
        reused_ids=errors.reused,
    )


def _median(values: FloatArray) -> float:
    if len(values):
        return float(np.median(values))
    return float("nan")


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{part:.4f}" for part in value)
    if isinstance(value, float):
        return f"{value:.4f}"
    return str(value)
