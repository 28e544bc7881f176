"""Focal length and principal point as the motion of the cameras shows them, beside the given
ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.calibration.findings import Fault, Finding, NotObservable
from vio.geometry.stereo import StereoCamera


@dataclass(frozen=True, slots=True)
class _IntrinsicRules:
    """When intrinsics are observable, and when they are called wrong."""

    # Standard deviations of what is left of a lens beyond its model, beside those of the estimate:
    # on four real drives with calibrations of their own, focal lengths came out by -0.4 to +3.3 %
    # and principal points by 1 to 4 % of a focal length from the given ones, with 0.3 to 0.7 % of
    # standard deviation.
    lens_focal: float = 0.012
    lens_centre: float = 0.02  # focal lengths
    largest_focal: float = 0.03  # standard deviations above which nothing can be said
    largest_centre: float = 0.05
    named_sigmas: float = 3.0


_JUDGED = _IntrinsicRules()


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """How far the given focal length and principal point are off."""

    focal_px: float  # as given, of the rectified images
    focal_off: float  # share of the given focal length
    focal_sigma: float  # standard deviation of that share
    centre_off_px: tuple[float, float]  # of the principal point, u and v
    centre_sigma_px: tuple[float, float]


def judged_observable(
    camera: StereoCamera,
    focal_off: float,
    focal_sigma: float,
    centre_off: tuple[float, float],
    centre_sigma: tuple[float, float],
) -> Intrinsics | NotObservable:
    """Return the intrinsics with the uncertainty that lens models leave, where the motion
    determines enough.

    A camera that does not turn sees the same with any focal length and principal point: the scene
    is only stretched.

    Args:
        camera: the pair as calibrated.
        focal_off: share of the given focal length.
        focal_sigma: its standard deviation.
        centre_off: of the principal point, focal lengths.
        centre_sigma: its standard deviations.
    """
    sigma = float(np.hypot(focal_sigma, _JUDGED.lens_focal))
    across = [float(np.hypot(s, _JUDGED.lens_centre)) for s in centre_sigma]
    if sigma > _JUDGED.largest_focal or max(across) > _JUDGED.largest_centre:
        return NotObservable(
            "focal length and principal point",
            f"the cameras turn too little: the standard deviations are {100 * sigma:.1f} % and "
            f"{camera.fu * max(across):.0f} px",
        )
    focal_px = np.array([camera.fu, camera.fv])
    off_u, off_v = (focal_px * centre_off).tolist()
    sigma_u, sigma_v = (focal_px * across).tolist()
    return Intrinsics(camera.fu, focal_off, sigma, (off_u, off_v), (sigma_u, sigma_v))


def judge_intrinsics(found: Intrinsics | NotObservable) -> tuple[Finding, ...]:
    """Return the faults of the given intrinsics."""
    if isinstance(found, NotObservable):
        return ()
    out: dict[Fault, str] = {}
    if abs(found.focal_off) > _JUDGED.named_sigmas * found.focal_sigma:
        out["focal length wrong"] = (
            f"off by {100 * found.focal_off:+.1f} % (standard deviation "
            f"{100 * found.focal_sigma:.1f} %): "
            f"{found.focal_px * (1 + found.focal_off):.0f} px in place of {found.focal_px:.0f}; "
            "calibrate the lenses "
            "again, and check that the images were not resized"
        )
    if any(
        abs(o) > _JUDGED.named_sigmas * s
        for o, s in zip(found.centre_off_px, found.centre_sigma_px, strict=True)
    ):
        (u, v) = found.centre_off_px
        (su, sv) = found.centre_sigma_px
        out["principal point wrong"] = (
            f"off by {u:+.0f} {v:+.0f} px along u v (standard deviations {su:.0f} {sv:.0f}); "
            "calibrate the lenses "
            "again, and check that the images were not cropped"
        )
    return tuple(Finding(*each) for each in out.items())
