"""Images that show the frame before as well."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.monitor import mixed_exposures
from vio.monitor.mixed_exposures import MixedExposures
from vio.records import Image, Observations, observations

HEIGHT = 240
WIDTH = 400
SINCE = 12  # the first frame that is mixed
_NOISE = np.random.default_rng(1).normal(0.0, 1.0, (HEIGHT, 6 * WIDTH)).astype(np.float32)
_BLURRED = np.asarray(cv2.GaussianBlur(_NOISE, (0, 0), 2.0), dtype=np.float64)
TEXTURE = 120.0 + 40.0 * _BLURRED / _BLURRED.std()
# columns and rows of the texture that features are at
CORNERS = np.stack(np.meshgrid(np.arange(0, 6 * WIDTH, 30), np.arange(30, HEIGHT, 30)), -1)
Exposures = list[FloatArray]
Mix = Callable[[Exposures, int], FloatArray]


def _exposures(steps_px: list[int]) -> Exposures:
    """Views that begin at the sums of some steps."""
    return [TEXTURE[:, at : at + WIDTH] for at in np.cumsum(steps_px).tolist()]


def _found(
    mix: Mix, steps_px: list[int], lost: tuple[int, ...] = (), repeated: tuple[int, ...] = ()
) -> list[Finding]:
    """Findings of frames of which some lose all features, or have the image of the one before."""
    exposures = _exposures(steps_px)
    rng = np.random.default_rng(2)
    check = MixedExposures()
    found: list[Finding] = []
    for k, at in enumerate(np.cumsum(steps_px).tolist()):
        image = mix(exposures, k) + rng.normal(0.0, 2.0, (HEIGHT, WIDTH))
        if k not in repeated:
            shown: Image = np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)
        place = CORNERS.reshape(-1, 2) - [at, 0]
        ids = np.flatnonzero((place[:, 0] >= 0) & (place[:, 0] < WIDTH))
        z = place[ids][:, [0, 1, 0, 1]]
        # features that are lost, and found as new ones
        seen = observations(k, k * 50_000_000, ids + (10_000 * k if k in lost else 0), z)
        found += check.frame(seen, shown)
    return found


def _clean(exposures: Exposures, k: int) -> FloatArray:
    return exposures[k]


def _blended(exposures: Exposures, k: int, share: float = 0.3) -> FloatArray:
    if not SINCE <= k < 30:
        return exposures[k]
    return (1.0 - share) * exposures[k] + share * exposures[k - 1]


def _every_second(exposures: Exposures, k: int) -> FloatArray:
    return _blended(exposures, k, 0.5) if k % 2 == 0 else exposures[k]


def _filtered(exposures: Exposures, k: int) -> FloatArray:
    out = exposures[min(k, SINCE)]
    for later in exposures[SINCE + 1 : k + 1]:
        out = 0.6 * later + 0.4 * out
    return out


def _behind_dirt(exposures: Exposures, k: int) -> FloatArray:
    return 0.6 * exposures[k] + 0.4 * TEXTURE[:, -WIDTH:]


# that the view moves by from frame to frame
STEPS_PX = np.random.default_rng(3).integers(6, 14, 60).tolist()


@pytest.mark.parametrize(("rows", "found"), [(1, False), (3, True)])
def test_few_moving_features_are_of_one_near_thing(
    monkeypatch: pytest.MonkeyPatch, rows: int, found: bool
) -> None:
    """13 features in view, and 39."""
    monkeypatch.setitem(globals(), "CORNERS", CORNERS[:rows])
    assert bool(_found(_blended, STEPS_PX)) == found


@pytest.mark.parametrize(
    ("mix", "lost"),
    [(_blended, ()), (_every_second, ()), (_filtered, ()), (_every_second, (14, 16, 18, 20))],
)
def test_the_frame_before_is_found_in_images(mix: Mix, lost: tuple[int, ...]) -> None:
    begun = _found(mix, STEPS_PX, lost)[0]
    assert begun.code == "exposures-mixed"
    assert begun.first_frame in (SINCE - 1, SINCE)  # from where the motion is in doubt
    assert begun.frame is not None
    assert begun.frame <= SINCE + 4
    assert begun.figures["share"] == pytest.approx(0.4, abs=0.12)


@pytest.mark.parametrize("since", range(40, 48))
def test_blends_that_begin_later_are_found_by_few_looks(
    since: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []

    def counted(seen: list[Observations], images: list[Image]) -> tuple[float, float] | None:
        looks.append(seen[-1].frame_index)
        return share_of_before(seen, images)

    share_of_before = mixed_exposures._share_of_before
    monkeypatch.setattr(mixed_exposures, "_share_of_before", counted)
    steps_px = [*STEPS_PX, *STEPS_PX][:70]

    def mix(exposures: Exposures, k: int) -> FloatArray:
        return 0.5 * (exposures[k] + exposures[k - 1]) if k >= since and k % 2 else exposures[k]

    begun = _found(mix, steps_px)[0]
    assert begun.first_frame is not None
    assert begun.frame is not None
    assert since - 7 <= begun.first_frame <= since
    assert begun.frame <= since + 12
    assert sum(25 <= k < since for k in looks) <= 0.4 * (since - 25) + 1


def test_it_ends_where_images_show_one_exposure_again() -> None:
    found = _found(_blended, STEPS_PX)
    assert [f.ended for f in found] == [False, True]
    assert found[1].frame is not None
    assert found[1].frame >= 30


def _fence(exposures: Exposures, k: int) -> FloatArray:
    """Boards that are as wide as the view moves by at times."""
    at = int(np.cumsum(STEPS_PX)[k])
    boards = 40.0 * np.sign(np.sin(2.0 * np.pi * (np.arange(WIDTH) + at) / 9.0))
    return 0.7 * exposures[k] + boards


@pytest.mark.parametrize("mix", [_clean, _behind_dirt])
@pytest.mark.parametrize(
    "steps_px",
    [
        STEPS_PX,
        [9] * 60,
        [2] * 60,
        [0] * 60,
        [*STEPS_PX[:20], 0, 0, *STEPS_PX[20:30], 0, -9, -9, 0, *STEPS_PX[30:40]],
    ],
    ids=["moving", "evenly", "slowly", "still", "stopping"],
)
def test_one_exposure_is_no_finding(mix: Mix, steps_px: list[int]) -> None:
    assert not _found(mix, steps_px)


def test_an_image_that_is_that_of_the_frame_before_is_no_finding() -> None:
    """A left camera that is frozen, while the right images are followed."""
    assert not _found(_clean, STEPS_PX, repeated=(15, 20, 21, 22, 23, 30, 35, 40))


def test_a_repeated_pattern_is_no_finding() -> None:
    assert not _found(_fence, STEPS_PX)


def test_more_of_the_frame_before_leaves_more_of_the_motion_in_doubt() -> None:
    little, much = (
        _found(lambda exposures, k, s=share: _blended(exposures, k, s), STEPS_PX)[0]  # type: ignore[misc]
        for share in (0.2, 0.4)
    )
    assert little.figures["doubted_share"] < 0.5 * much.figures["doubted_share"]
    whole = _found(_every_second, STEPS_PX)[0]
    assert whole.figures["doubted_share"] == pytest.approx(1.0, abs=0.15)
