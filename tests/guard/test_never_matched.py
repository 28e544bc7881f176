"""Right matches that no frame has had yet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from vio.findings import Finding
from vio.frontend import build_frontend
from vio.frontend.settings import FrontendSettings
from vio.guard.guarded import guarded
from vio.guard.never_matched import NeverMatched
from vio.records import observations


def codes(found: Iterable[Finding]) -> list[str]:
    """Return the codes of findings, with a minus before those that ended."""
    return ["-" * finding.ended + finding.code for finding in found]


@pytest.mark.parametrize(("share", "missing"), [(0.05, True), (0.07, False)])
def test_hardly_any_match_from_the_first_frame_on_is_reported(share: float, missing: bool) -> None:
    """Right images that are turned, or of another recording, have never had any."""
    check = NeverMatched()
    for k in range(20):
        has_right = np.arange(100) < 100 * (share if k < 15 else 0.5)
        check.see(observations(k, k, np.arange(100), np.zeros((100, 4)), has_right))
    found = check.take_findings()
    code = "right-matches-missing"
    assert codes(found) == ([code, f"-{code}"] if missing else [])
    assert all(finding.effect == "unusable" for finding in found[:1])


def test_matches_that_were_there_once_are_not_missing() -> None:
    check = NeverMatched()
    for k in range(20):
        has_right = np.arange(100) < (50 if k == 3 else 0)
        check.see(observations(k, k, np.arange(100), np.zeros((100, 4)), has_right))
    assert check.take_findings() == ()


def test_a_right_image_upside_down_is_reported() -> None:
    frontend = guarded(build_frontend("klt", CAMERA, FrontendSettings()), CAMERA)
    found = []
    for frame in (stereo_frame(k, T) for k, T in enumerate(flight(8))):
        assert frame.right is not None
        turned = replace(frame, right=np.ascontiguousarray(frame.right[::-1, ::-1]))
        found += codes(frontend.process(turned).findings)
    assert found == ["right-matches-missing"]
