"""Front ends between the checks, and what these say."""

from __future__ import annotations

from typing import Protocol

from vio.findings import Finding
from vio.frontend.klt import KltFrontend
from vio.frontend.settings import FrontendSettings
from vio.geometry.stereo import StereoCamera
from vio.guard.guarded import GuardedFrontend
from vio.records import FrontendOutput


class Check(Protocol):
    """Whatever finds something."""

    def take_findings(self) -> tuple[Finding, ...]:
        """The findings since the last call."""


def guarded_klt(camera: StereoCamera, settings: FrontendSettings | None = None) -> GuardedFrontend:
    """The default front end as a run builds it."""
    return GuardedFrontend(KltFrontend(camera, settings), camera)


def messages(output: FrontendOutput) -> list[str]:
    """What a frame says of its images."""
    return [finding.message for finding in output.findings]


def lines_of(check: Check) -> list[str]:
    """What a check has found since the last call."""
    return [finding.message for finding in check.take_findings()]


def codes(outputs: list[FrontendOutput]) -> list[str]:
    """The codes of what some frames say, with `-` before those of what has ended."""
    found: list[Finding] = [finding for output in outputs for finding in output.findings]
    return [f"-{finding.code}" if finding.ended else finding.code for finding in found]
