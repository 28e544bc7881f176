"""Camera effects on an ideal image: lens, exposure, blur, noise, response.

Seeded and reproducible to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vio.errors import SimulationError
from vio.geometry.lie import FloatArray
from vio.records import Image
from vio.setting import setting
from vio.sim.render import Radiance

_FULL_SCALE = 255.0


@dataclass(frozen=True, slots=True)
class SensorEffects:
    """Camera effects; the defaults are a clean, well exposed sensor with a little read noise."""

    exposure: float = setting(1.0, "factor on the light of both cameras; 0.05 is near darkness")
    right_gain: float = setting(
        1.0, "further factor on the right camera's signal, for cameras of unequal gain"
    )
    exposure_swing: float = setting(
        0.0, "relative amplitude of a slow change of exposure", unit="0..1"
    )
    exposure_period_s: float = setting(6.0, "period of that change", unit="s")
    vignetting: float = setting(0.0, "loss of light in the image corners", unit="0..1")
    gamma: float = setting(1.0, "exponent of the response: output = input^(1/gamma)")
    read_noise: float = setting(0.8, "standard deviation of the read noise", unit="gray levels")
    full_well: float = setting(
        0.0, "electrons at gray level 255, which sets the photon noise; 0 is none"
    )
    blur_exposure_ms: float = setting(
        0.0, "shutter time over which motion blurs the image", unit="ms"
    )
    blur_samples: int = setting(7, "sub-exposures, or taps of the approximate blur")
    blur_exact: bool = setting(
        False, "render every sub-exposure; else blur one image along its exact optical flow"
    )
    readout_ms: float = setting(
        0.0,
        "rolling shutter: time from the exposure of the first row to that of the last; stamps are "
        "those of the middle row",
        unit="ms",
    )
    auto_exposure: bool = setting(
        False, "each camera's own exposure control sets shutter time and gain of each frame"
    )
    shutter_ms: float = setting(
        8.0, "shutter time that leaves the scene's gray levels, with auto_exposure", unit="ms"
    )
    shutter_max_ms: float = setting(
        12.0, "longest shutter time; where it does not do, gain is added", unit="ms"
    )
    gain_max: float = setting(8.0, "largest gain of the exposure control")
    exposure_target: float = setting(95.0, "mean gray level that the exposure control aims at")
    camera_difference: float = setting(
        0.0, "how much the cameras differ: vignetting, mean gray level", unit="0..1"
    )
    glare: float = setting(
        0.0, "light of windows and sun scattered in the lens: halo and ghosts; 1 is a usual lens"
    )

    def __post_init__(self) -> None:
        if min(self.exposure, self.right_gain, self.blur_samples - 1) < 0 or self.gamma <= 0:
            raise SimulationError(
                "exposure and gain must not be negative; gamma and blur_samples must be positive"
            )
        if not (0 <= self.vignetting <= 1 and 0 <= self.exposure_swing <= 1):
            raise SimulationError("vignetting and exposure_swing must be between 0 and 1")
        if min(self.read_noise, self.full_well, self.blur_exposure_ms) < 0:
            raise SimulationError("read_noise, full_well and blur_exposure_ms must not be negative")
        control = min(self.shutter_ms, self.shutter_max_ms, self.exposure_target)
        if control <= 0 or self.gain_max < 1:
            raise SimulationError(
                "shutter times and exposure_target must be positive, gain_max at least 1"
            )
        if not (0 <= self.camera_difference <= 1 and self.glare >= 0):
            raise SimulationError(
                "camera_difference must be between 0 and 1, and glare not negative"
            )

    @property
    def longest_shutter_ms(self) -> float:
        """The longest shutter time that any frame may have, ms."""
        return self.shutter_max_ms if self.auto_exposure else self.blur_exposure_ms

    @property
    def longest_exposure_ms(self) -> float:
        """The longest time between the first light of a frame and its last, ms."""
        return self.longest_shutter_ms + abs(self.readout_ms)


CLEAN = SensorEffects(read_noise=0.0)


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure of one image by a camera with exposure control."""

    shutter_ms: float
    gain: float = 1.0  # of the amplifier, which raises signal and noise alike


def sensitivity(effects: SensorEffects, camera: int) -> float:
    """Return a camera's gray levels over those of the scene, at the nominal exposure."""
    return effects.exposure * (effects.right_gain if camera else 1.0)


def camera_factor(effects: SensorEffects, camera: int, seed: int) -> float:
    """Return a factor about 1 by which a camera's vignetting and mean gray level deviate."""
    return 1 + effects.camera_difference * float(
        np.random.default_rng([seed, camera, 32]).uniform(-1, 1)
    )


def apply_effects(
    radiance: Radiance,
    effects: SensorEffects,
    *,
    time_ns: int,
    frame_index: int,
    camera: int,
    seed: int,
    exposure: Exposure | None = None,
) -> Image:
    """Convert a linear image (H, W) in gray levels to the sensor's output, uint8.

    Args:
        radiance: linear image.
        effects: the sensor.
        time_ns: time of exposure, for the slow change of exposure.
        frame_index: number of the frame, for the noise.
        camera: 0 left, 1 right.
        seed: of the noise and of the cameras' difference.
        exposure: what the camera's exposure control has set; None: it has none.
    """
    gain = sensitivity(effects, camera)
    amplifier = 1.0
    if exposure is not None:
        amplifier = exposure.gain
        gain *= exposure.shutter_ms / effects.shutter_ms * amplifier
    gain *= 1 + effects.exposure_swing * float(
        np.sin(2 * np.pi * time_ns * 1e-9 / effects.exposure_period_s)
    )
    signal = radiance * np.float32(gain)
    if effects.vignetting > 0:
        signal *= _vignette(radiance.shape, effects, camera, seed)
    rng = np.random.default_rng([seed, frame_index, camera, 31])
    read = effects.read_noise * amplifier
    if effects.full_well > 0:
        # One draw for both: electrons e have variance e, and a gray level is 255 gain / full_well
        # electrons.
        variance = np.maximum(signal, 0) * np.float32(_FULL_SCALE * amplifier / effects.full_well)
        sigma = np.sqrt(variance + np.float32(read**2))
        signal = signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    elif read > 0:
        signal = signal + np.float32(read) * rng.standard_normal(signal.shape, dtype=np.float32)
    if effects.gamma != 1.0:
        signal = _FULL_SCALE * (
            np.clip(signal, 0, _FULL_SCALE) / np.float32(_FULL_SCALE)
        ) ** np.float32(1 / effects.gamma)
    return np.clip(signal + np.float32(0.5), 0, 255).astype(np.uint8)


def _vignette(
    shape: tuple[int, ...], effects: SensorEffects, camera: int, seed: int
) -> npt.NDArray[np.float32]:
    """Factor (H, W): 1 in the middle, falling with the square of the radius to 1 - loss in the
    corners.

    With different cameras the middle is off the image's and the loss another one in each of them.
    """
    height, width = shape
    loss = min(1.0, effects.vignetting * camera_factor(effects, camera, seed))
    off = effects.camera_difference * np.random.default_rng([seed, camera, 33]).uniform(-1, 1, 2)
    y = np.linspace(-1 - off[1], 1 - off[1], height, dtype=np.float32)[:, None]
    x = np.linspace(-1 - off[0], 1 - off[0], width, dtype=np.float32)[None]
    return np.maximum(1 - np.float32(loss / 2) * (x * x + y * y), np.float32(0))


def average_exposures(
    render_at: Callable[[int], Radiance], time_ns: int, shutter_ms: float, samples: int
) -> Radiance:
    """Average sub-exposures spread evenly over the shutter time, centred at `time_ns`.

    `render_at(time_ns)` renders the sharp image at one time.
    """
    offsets = np.round(((np.arange(samples) + 0.5) / samples - 0.5) * shutter_ms * 1e6).astype(
        np.int64
    )
    total = render_at(time_ns + int(offsets[0])).astype(np.float32)
    for offset in offsets[1:]:
        total = total + render_at(time_ns + int(offset))
    return total / np.float32(len(offsets))


def along_flow(image: Radiance, flow: FloatArray) -> Radiance:
    """Return the image (H, W) that shows at each pixel what another one has a flow (H, W, 2) from
    there, pixels.
    """
    # INTER_CUBIC moves smooth images by up to 0.048 px (F126), this one by 0.015.
    at = (flow + _pixels(image.shape)).astype(np.float32)
    return _looked_up(image, at, cv2.INTER_LANCZOS4)


def _pixels(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Pixels (H, W, 2) of an image."""
    height, width = shape
    u = np.arange(width, dtype=np.float32)
    v = np.arange(height, dtype=np.float32)
    return np.stack(np.meshgrid(u, v), axis=-1)


def _looked_up(image: Radiance, at: npt.NDArray[Any], interpolation: int) -> Radiance:
    """An image (H, W) at pixels (H, W, 2), its border repeated."""
    # One map of both coordinates, which OpenCV's stubs do not know.
    return cv2.remap(  # type: ignore[call-overload]
        image, at, None, interpolation, borderMode=cv2.BORDER_REPLICATE
    )


def blur_along_flow(
    sharp: Radiance, flow_before: FloatArray, flow_after: FloatArray, taps: int
) -> Radiance:
    """Blur one sharp image (H, W) along its optical flow: the approximate motion blur.

    Each pixel is the mean of taps along the path on which its point crosses the image, so
    disocclusions are ignored; `average_exposures` renders them.

    Args:
        sharp: image at the middle of the shutter time.
        flow_before: (H, W, 2) pixels from here to where the point is when the shutter opens.
        flow_after: (H, W, 2) pixels from here to where the point is when it closes.
        taps: number of samples along the path.
    """
    here = _pixels(sharp.shape)
    before, after = (np.asarray(flow, dtype=np.float32) for flow in (flow_before, flow_after))
    total = np.zeros_like(sharp)
    for position in (np.arange(taps) + 0.5) / taps * 2 - 1:
        # The pixel's content at another time is found upstream along the flow.
        at = cv2.scaleAdd(after if position > 0 else before, -abs(float(position)), here)
        cv2.accumulate(_looked_up(sharp, at, cv2.INTER_LINEAR), total)
    total *= np.float32(1 / taps)
    return total
