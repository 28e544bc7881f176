"""What a lens model is: projection, inverse, derivatives, limits, and its names in files.

A model maps a point (x, y, z) of the camera frame (x right, y down, z forward) to the normalised
image plane; the pixel is `u = fu x' + cu`, `v = fv y' + cv`. A new model is a class in a file of
this folder with an instance called `LENS`, and a line in `registry.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import field
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance

BoolArray: TypeAlias = npt.NDArray[np.bool_]
Coefficients: TypeAlias = tuple[float, ...]
TINY: Tolerance[float] = 1e-12


@dataclass(frozen=True, slots=True)
class KalibrForm:
    """A model in Kalibr's camchain."""

    camera: str  # camera_model
    distortion: str  # distortion_model, as it is written
    leading: int  # coefficients that stand before fu fv cu cv in `intrinsics`


@dataclass(frozen=True, slots=True)
class ToolForm:
    """A model in the files of a tool that names models in a way of its own."""

    tool: str  # whose files they are
    name: str  # of the model there, in small letters
    # names of its coefficients there, in our order; an empty name is a zero
    coefficients: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FileNames:
    """What files call a model, by the number of its coefficients; absent: they do not know it."""

    distortion: tuple[
        str, ...
    ] = ()  # names of a `distortion_model` that are read, in small letters
    kalibr: Mapping[int, KalibrForm] = field(default_factory=dict)
    ros: Mapping[int, str] = field(default_factory=dict)  # of a CameraInfo, as written
    basalt: str | None = (
        None  # camera_type; it takes all coefficients, by the names in small letters
    )
    # entries of Basalt that are no coefficients, as written
    basalt_constants: Mapping[str, float] = field(default_factory=dict)
    tools: tuple[ToolForm, ...] = ()  # of files that are read and not written
    sensor_yaml: str | None = None  # distortion_model of EuRoC's sensor.yaml, as written
    opencv: bool = False  # whether OpenCV's calib3d takes the coefficients as they are
    # name, and number of coefficients, the missing of which are zero there
    colmap: Mapping[int, tuple[str, int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Choice:
    """A model with a number of coefficients, as `vio calibrate-rig` chooses among them."""

    name: str
    count: int  # of coefficients
    # Of models that fit equally well the least one is chosen: what more programs read comes first,
    # and then what has fewer coefficients.
    rank: int


class Lens(ABC):
    """A lens model. It has no state: its coefficients are passed to each method."""

    name: ClassVar[str]
    parameters: ClassVar[tuple[str, ...]] = ()  # names of the coefficients, in their order
    counts: ClassVar[tuple[int, ...]]  # numbers of coefficients that it may have
    files: ClassVar[FileNames] = FileNames()
    choices: ClassVar[tuple[Choice, ...]] = ()
    # Straight lines stay nearly straight: rays are tabulated at unit depth, as in a pinhole image.
    planar: ClassVar[bool] = False
    # Tiles along a row over which the renderer takes the change of rays from pixel to pixel as
    # constant.
    linear_tiles: ClassVar[int] = 1
    zero_is_pinhole: ClassVar[bool] = False  # coefficients that are all zero make a pinhole

    def fault(self, c: Coefficients) -> str | None:
        """Return why coefficients are impossible, as a sentence; None: they are possible."""
        return None

    @abstractmethod
    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Normalised plane (..., 2) of points (..., 3), and a mask (...) of those that the model
        can project; the others' values are finite.
        """

    @abstractmethod
    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit rays (..., 3) of points (..., 2) of the normalised plane, and a mask (...) of those
        inside the model; the others' rays are finite.
        """

    @abstractmethod
    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (..., 2, 3) and (..., 2, n) of `project` by points (..., 3) and by the n
        coefficients, where the model can project.
        """

    @abstractmethod
    def max_angle(self, c: Coefficients) -> float:
        """Angle off the axis in radians up to which the model projects."""

    @abstractmethod
    def start(self, count: int) -> Coefficients:
        """Coefficients from which a calibration begins."""

    def focal_factor(self, c: Coefficients) -> float:
        """Return the focal length over the pixels per radian on the axis."""
        return 1.0

    def radius_powers(self, count: int) -> tuple[int, ...]:
        """Powers of the radius that each coefficient multiplies: how it follows when the plane is
        scaled. Zeros: it does not.
        """
        return (0,) * count

    def bent(
        self, c: Coefficients, radial: tuple[float, float], tangential: tuple[float, float]
    ) -> tuple[str, Coefficients]:
        """Return the model and its coefficients with more distortion, k1 k2 and p1 p2, as far as
        the model holds it; what it does not hold has no effect.
        """
        return self.name, c


def near_axis(p: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Distance (...) of points (..., 3) from the axis, at least `TINY`, and those that lie on it."""
    radius = np.linalg.norm(p[..., :2], axis=-1)
    on_axis = np.asarray(radius < TINY)
    return np.where(on_axis, TINY, radius), on_axis


def plane_by_point(p: FloatArray, scale: FloatArray, scale_by_p: FloatArray) -> FloatArray:
    """Derivative (..., 2, 3) of `(x, y) scale` by points (..., 3).

    Args:
        p: points (..., 3).
        scale: (...) of the point.
        scale_by_p: (..., 3) its derivative.
    """
    out = np.asarray(p[..., :2, None] * scale_by_p[..., None, :])
    out[..., 0, 0] += scale
    out[..., 1, 1] += scale
    return out


def unit_ray(xy: FloatArray, scale: FloatArray, z: FloatArray) -> FloatArray:
    """Return (scale x, scale y, z) at unit length (..., 3); the axis where that vanishes."""
    ray = np.concatenate([scale[..., None] * xy, z[..., None]], axis=-1)
    length = np.linalg.norm(ray, axis=-1, keepdims=True)
    return np.where(length > TINY, ray / np.where(length > TINY, length, 1.0), [0.0, 0.0, 1.0])
