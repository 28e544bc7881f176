"""Camera effects on an ideal image: lens, exposure, blur, noise, response. Seeded and reproducible to the bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.records import Image
from vio.setting import setting
from vio.sim.errors import SimulationError
from vio.sim.render import Radiance

_FULL_SCALE = 255.0


@dataclass(frozen=True, slots=True)
class SensorEffects:
    """Camera effects; the defaults are a clean, well exposed sensor with a little read noise."""

    exposure: float = setting(1.0, "factor on the light of both cameras; 0.05 is near darkness")
    right_gain: float = setting(1.0, "further factor on the right camera's signal, for cameras of unequal gain")
    exposure_swing: float = setting(0.0, "relative amplitude of a slow change of exposure", unit="0..1")
    exposure_period_s: float = setting(6.0, "period of that change", unit="s")
    vignetting: float = setting(0.0, "loss of light in the image corners", unit="0..1")
    gamma: float = setting(1.0, "exponent of the response: output = input^(1/gamma)")
    read_noise: float = setting(0.8, "standard deviation of the read noise", unit="gray levels")
    full_well: float = setting(0.0, "electrons at gray level 255, which sets the photon noise; 0 is none")
    blur_exposure_ms: float = setting(0.0, "shutter time over which motion blurs the image", unit="ms")
    blur_samples: int = setting(7, "sub-exposures, or taps of the approximate blur")
    blur_exact: bool = setting(False, "render every sub-exposure; else blur one image along its exact optical flow")

    def __post_init__(self) -> None:
        if self.exposure < 0 or self.right_gain < 0 or self.gamma <= 0 or self.blur_samples < 1:
            raise SimulationError("exposure and gain must not be negative; gamma and blur_samples must be positive")
        if not (0 <= self.vignetting <= 1 and 0 <= self.exposure_swing <= 1):
            raise SimulationError("vignetting and exposure_swing must be between 0 and 1")
        if self.read_noise < 0 or self.full_well < 0 or self.blur_exposure_ms < 0:
            raise SimulationError("read_noise, full_well and blur_exposure_ms must not be negative")


CLEAN = SensorEffects(read_noise=0.0)


def apply_effects(
    radiance: Radiance, effects: SensorEffects, *, time_ns: int, frame_index: int, camera: int, seed: int
) -> Image:
    """Convert a linear image (H, W) in gray levels to the sensor's output, uint8.

    Args:
        radiance: linear image.
        effects: the sensor.
        time_ns: time of exposure, for the slow change of exposure.
        frame_index: number of the frame, for the noise.
        camera: 0 left, 1 right.
        seed: of the noise.
    """
    gain = effects.exposure * (effects.right_gain if camera else 1.0)
    gain *= 1 + effects.exposure_swing * float(np.sin(2 * np.pi * time_ns * 1e-9 / effects.exposure_period_s))
    signal = radiance * np.float32(gain)
    if effects.vignetting > 0:
        signal *= _vignette(radiance.shape, effects.vignetting)
    rng = np.random.default_rng([seed, frame_index, camera, 31])
    if effects.full_well > 0:
        electrons = np.maximum(signal, 0) * np.float32(effects.full_well / _FULL_SCALE)
        shot = np.sqrt(electrons) * rng.standard_normal(signal.shape, dtype=np.float32)
        signal = signal + shot * np.float32(_FULL_SCALE / effects.full_well)
    if effects.read_noise > 0:
        signal = signal + np.float32(effects.read_noise) * rng.standard_normal(signal.shape, dtype=np.float32)
    if effects.gamma != 1.0:
        signal = _FULL_SCALE * (np.clip(signal, 0, _FULL_SCALE) / np.float32(_FULL_SCALE)) ** np.float32(
            1 / effects.gamma
        )
    out: Image = np.clip(signal + np.float32(0.5), 0, 255).astype(np.uint8)
    return out


def _vignette(shape: tuple[int, ...], loss: float) -> npt.NDArray[np.float32]:
    """Factor (H, W): 1 in the middle, falling with the square of the radius to 1 - loss in the corners."""
    height, width = shape
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, width, dtype=np.float32)[None]
    return 1 - np.float32(loss / 2) * (x * x + y * y)


def average_exposures(render_at: Callable[[int], Radiance], time_ns: int, effects: SensorEffects) -> Radiance:
    """Average sub-exposures spread evenly over the shutter time, centred at `time_ns`.

    `render_at(time_ns)` renders the sharp image at one time.
    """
    offsets = _shutter(effects)
    total = render_at(time_ns + int(offsets[0])).astype(np.float32)
    for offset in offsets[1:]:
        total = total + render_at(time_ns + int(offset))
    out: Radiance = total / np.float32(len(offsets))
    return out


def _shutter(effects: SensorEffects) -> npt.NDArray[np.int64]:
    """Times (N,) of the sub-exposures relative to the middle of the shutter, ns; symmetric about zero."""
    n = effects.blur_samples
    return np.round(((np.arange(n) + 0.5) / n - 0.5) * effects.blur_exposure_ms * 1e6).astype(np.int64)


def blur_along_flow(
    sharp: Radiance, flow_before: FloatArray, flow_after: FloatArray, effects: SensorEffects
) -> Radiance:
    """Blur one sharp image (H, W) along its optical flow: the approximate motion blur.

    Each pixel is the mean of taps along the path on which its point crosses the image, so disocclusions are
    ignored; `average_exposures` renders them.

    Args:
        sharp: image at the middle of the shutter time.
        flow_before: (H, W, 2) pixels from here to where the point is when the shutter opens.
        flow_after: (H, W, 2) pixels from here to where the point is when it closes.
        effects: sets the number of taps.
    """
    n = effects.blur_samples
    height, width = sharp.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    total = np.zeros_like(sharp)
    for position in (np.arange(n) + 0.5) / n * 2 - 1:
        # The pixel's content at another time is found upstream along the flow.
        flow = flow_after if position > 0 else flow_before
        step = -abs(float(position)) * flow.astype(np.float32)
        total += cv2.remap(sharp, u + step[..., 0], v + step[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    out: Radiance = total / np.float32(n)
    return out
