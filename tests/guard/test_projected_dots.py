"""Dots of a projector: named and taken out; images without them stay as they are."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
import pytest

from tests.guards import guarded_klt
from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.guarded import GuardedFrontend
from vio.guard.image_check import FrameImages
from vio.guard.projected_dots import ProjectedDots, without_dots
from vio.guard.repairing import AS_READ, Repair, repaired
from vio.records import Image, StereoFrame, shared_rows

SHAPE = (240, 320)
STEP_NS = 50_000_000
_RNG = np.random.default_rng(4)
NOISE = _RNG.integers(0, 256, (SHAPE[0], 1200)).astype(np.uint8)
SCENE = cv2.normalize(cv2.GaussianBlur(NOISE, (0, 0), 2.0), NOISE.copy(), 40, 180, cv2.NORM_MINMAX)


def dots(shape: tuple[int, ...], shift: float = 0.0, count: int = 900) -> FloatArray:
    """Gray levels (H, W) of bright spots that are seen some pixels further left."""
    rng = np.random.default_rng(5)
    v, u = rng.uniform(0, 1, (2, count)) * np.array(shape)[:, None]
    out = np.zeros(shape)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    for x, y in zip(u - shift, v, strict=True):
        near = slice(max(int(y) - 4, 0), int(y) + 5), slice(max(int(x) - 4, 0), max(int(x) + 5, 0))
        square = (rows[near] - y) ** 2 + (columns[near] - x) ** 2
        out[near] += 80 * np.exp(-square / (2 * 0.9**2))
    return out


DOTS = dots(SHAPE)


def scene(k: int, speed: int = 5) -> FloatArray:
    """Frame k of a camera that moves sideways, with sensor noise."""
    noise = np.random.default_rng(k).normal(0, 1.0, SHAPE)
    return np.asarray(SCENE[:, speed * k : speed * k + SHAPE[1]] + noise)


def gray(image: FloatArray) -> Image:
    return np.clip(image, 0, 255).astype(np.uint8)


def inspect(
    images: Iterable[FloatArray], step_ns: int = STEP_NS
) -> tuple[list[Finding], list[bool], Image]:
    """What is found, whether each image is handed on as it came, and the last one handed on."""
    check = ProjectedDots()
    kept = []
    for k, image in enumerate(images):
        given = gray(image)
        out = check.inspect(FrameImages(StereoFrame(k, k * step_ns, given, given), (given, given)))
        kept.append(out.raw[0] is given)
    return list(check.take_findings()), kept, out.raw[0]


def test_dots_are_named_once_and_taken_out() -> None:
    (finding,), kept, last = inspect(scene(k) + DOTS for k in range(40))
    assert (finding.code, finding.frame, finding.first_frame) == ("projected-dots", 12, 0)
    assert kept == [k < 12 for k in range(40)]
    on_dots = DOTS > 60
    assert (scene(39) + DOTS)[on_dots].mean() - scene(39)[on_dots].mean() > 60
    assert abs(last[on_dots].mean() - scene(39)[on_dots].mean()) < 15


def test_dots_that_are_switched_on_later_hold_from_then_on() -> None:
    (finding,), _, _ = inspect(scene(k) + DOTS * (k >= 18) for k in range(40))
    assert finding.frame == 32
    assert finding.first_frame == 20  # the last image that moved and showed none


def test_images_are_compared_by_time_not_by_number() -> None:
    (finding,), _, _ = inspect((scene(k, 15) + DOTS for k in range(20)), 200_000_000)
    assert finding.frame == 3
    found, _, _ = inspect((scene(k, 15) + DOTS for k in range(20)), 1_100_000_000)
    assert found == []


FIXED = np.random.default_rng(6).normal(0, 6, SHAPE)
HOOD = np.arange(SHAPE[0])[:, None] > 80
MOVING: dict[str, Callable[[int], FloatArray]] = {
    "no dots": scene,
    "a still rig": lambda k: scene(0) + DOTS + 0.01 * k,
    "an object on the rig": lambda k: np.where(HOOD, scene(0), scene(k)),
    "dots on an object on the rig": lambda k: np.where(HOOD, scene(0) + DOTS, scene(k)),
    "a fixed pattern of the sensor": lambda k: 0.3 * scene(k) + FIXED,
    "dark spots": lambda k: scene(k) - DOTS,
    "snow": lambda k: scene(k) + np.roll(DOTS, 37 * k, axis=0),
    "dots that are of the scene": lambda k: np.roll(scene(0) + DOTS, -5 * k, axis=1),
}


@pytest.mark.parametrize("name", list(MOVING))
def test_what_is_no_projector_is_left_as_it_is(name: str) -> None:
    found, kept, _ = inspect(MOVING[name](k) for k in range(40))
    assert found == []
    assert all(kept)


SPEED_PX = 5
DISPARITY_PX = 10
CAMERA = StereoCamera(
    fu=300.0, fv=300.0, cu=159.5, cv=119.5, baseline_m=0.2, width=SHAPE[1], height=SHAPE[0]
)


def lit_pair(k: int) -> StereoFrame:
    """Frame k of two cameras that move sideways before a wall with dots."""
    at = SPEED_PX * k
    images = (SCENE[:, at + d : at + d + SHAPE[1]] for d in (0, DISPARITY_PX))
    spots = (DOTS, dots(SHAPE, DISPARITY_PX))
    left, right = (gray(image + lit) for image, lit in zip(images, spots, strict=True))
    return StereoFrame(k, k * STEP_NS, left, right)


def flow_errors(frontend: GuardedFrontend, frames: int) -> FloatArray:
    """Errors (N, 2) in pixels of the last step of the features that are followed."""
    outputs = [frontend.process(lit_pair(k)) for k in range(frames)]
    before, after = (output.observations for output in outputs[-2:])
    a, b = shared_rows(before.ids, after.ids)
    return np.asarray(after.z[b, :2] - before.z[a, :2] + [SPEED_PX, 0])


@pytest.mark.parametrize("removed", [True, False], ids=["removed", "control"])
def test_features_follow_the_scene_and_not_the_dots(
    removed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not removed:
        monkeypatch.setattr(ProjectedDots, "inspect", lambda self, images: images)
    errors = flow_errors(guarded_klt(CAMERA), 24)
    pulled_px = float(np.mean(errors[:, 0]))  # towards rest
    if removed:
        assert len(errors) > 250
        assert abs(pulled_px) < 0.04
    else:
        assert len(errors) < 150
        assert pulled_px > 0.06


def test_a_run_begins_again_where_dots_were_there_from_the_start() -> None:
    def found(since: int) -> Finding:
        return Finding("projected-dots", "text", 30, since, lasts=True)

    repair = AS_READ.adding(found(0))
    assert repair
    assert AS_READ.adding(found(1)) is AS_READ
    assert repair.adding(found(0)) == repair
    assert Repair.of_json(repair.to_json()) == repair
    assert [code for code, _ in repair.lines()] == ["projected-dots"]
    (out,) = repaired([lit_pair(0)], repair, CAMERA)
    assert isinstance(out, StereoFrame)
    given = lit_pair(0)
    for image, other in ((out.left, given.left), (out.right, given.right)):
        assert image is not None
        assert other is not None
        np.testing.assert_array_equal(image, without_dots(other))


def test_the_opening_grows_with_the_images() -> None:
    spot = np.zeros((60, 1250), dtype=np.uint8)
    spot[28:33, 598:603] = 255  # 5 px wide
    assert without_dots(spot).max() == 0
    assert without_dots(np.ascontiguousarray(spot[:, 400:800])).max() == 255
