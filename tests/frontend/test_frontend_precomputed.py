"""Replay of recorded observations, and selection of a front end by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vio.errors import ConfigError, DataError
from vio.frontend import BUILDERS, FrontendSettings, build_frontend
from vio.frontend.klt import KltFrontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.geometry.stereo import StereoCamera
from vio.records import Event, Observations, Recording, StereoFrame, observations

CAMERA = StereoCamera(300.0, 300.0, 160.0, 120.0, 0.1, 320, 240)


def recorded(index: int, ids: list[int], has_right: list[bool] | None = None) -> Observations:
    z = np.random.default_rng(index).uniform(0, 100, (len(ids), 4))
    return observations(index, index * 1000, ids, z, has_right)


RECORD = {
    0: recorded(0, [3, 5, 9]),
    1: recorded(1, [5, 9, 11, 12], [True, False, True, True]),
    2: recorded(2, []),
}


def frame(index: int) -> StereoFrame:
    return StereoFrame(index, index * 1000, None, None)


def test_recorded_observations_come_back_unchanged() -> None:
    frontend = PrecomputedFrontend(RECORD.get)
    for index in range(3):
        assert frontend.process(frame(index)).observations is RECORD[index]


def test_counts_new_and_continued_features() -> None:
    frontend = PrecomputedFrontend(RECORD.get)
    counts = [
        (o.tracked, o.matched, o.detected) for o in (frontend.process(frame(k)) for k in range(3))
    ]
    assert counts == [(0, 3, 3), (2, 3, 2), (0, 0, 0)]


def test_error_names_a_frame_without_observations() -> None:
    with pytest.raises(DataError, match="frame 7 has no precomputed observations"):
        PrecomputedFrontend(RECORD.get).process(frame(7))


class FakeDataset:
    """A dataset with features only, or with images only."""

    def __init__(self, has_images: bool) -> None:
        self._has_images = has_images

    @property
    def recording(self) -> Recording:
        return Recording(
            "fake",
            Path(),
            CAMERA,
            None,
            np.array([0]),
            self._has_images,
            frozenset(),
            reference=None,
        )

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        yield frame(start)

    def observations(self, index: int) -> Observations | None:
        return RECORD.get(index)


def test_builders_create_the_named_front_end() -> None:
    kinds = {"klt": KltFrontend, "precomputed": PrecomputedFrontend}
    for name, kind in kinds.items():
        assert name in BUILDERS
        assert isinstance(build_frontend(name, CAMERA, FrontendSettings(), FakeDataset(True)), kind)


def test_auto_selects_by_content_of_the_recording() -> None:
    assert isinstance(
        build_frontend("auto", CAMERA, FrontendSettings(), FakeDataset(True)), KltFrontend
    )
    without = build_frontend("auto", CAMERA, FrontendSettings(), FakeDataset(False))
    assert isinstance(without, PrecomputedFrontend)
    assert without.process(frame(0)).observations is RECORD[0]


def test_error_for_unknown_name_lists_known_ones() -> None:
    dataset = SimpleNamespace()
    with pytest.raises(ConfigError, match=r"'orbit'.*auto, klt, orb, sift, kornia, precomputed"):
        build_frontend("orbit", CAMERA, FrontendSettings(), dataset)


def test_settings_do_not_import_opencv() -> None:
    """The command line lists settings in half a second; OpenCV alone takes longer to import."""
    import subprocess
    import sys

    code = "import sys, frontend, frontend.settings; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
