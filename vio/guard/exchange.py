"""Left and right images that are exchanged for a while: put back, or refused where they do not fit
each other then.

Each image is compared with both of the last frame. The camera's motion shifts both images alike, so
they differ from their own last images by about the same; from the other camera's last image, one
differs by motion plus disparity and the other by motion minus disparity. Where it is the other way
round, matches decide: exchanged images match with negative disparities only. So do those of a right
camera that has turned, but near points still have the larger ones (`vio.guard.depth_order`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import cv2
import numpy as np

from vio.dataclass import dataclass
from vio.findings import begun, ended
from vio.guard.image_change import image_change
from vio.guard.image_check import FrameImages, ImageCheck
from vio.guard.probe import RowProbe
from vio.numerics.kinds import Capacity
from vio.records import Image

Order: TypeAlias = Literal["given", "exchanged", "refused"]


@dataclass(frozen=True, slots=True)
class _ExchangeRules:
    """When images look exchanged, and when matches prove it."""

    # width and height, so coarse that a shift of the image by some pixels changes little
    thumbnail: tuple[int, int] = (48, 30)
    halvings: Capacity[int] = 2  # before it is averaged to that size
    min_points: int = 20
    exchanged_share: float = (
        0.4  # share of points with a negative disparity that proves an exchange
    )
    # share of them above which a frame that looks exchanged is refused: its rows do not fit when
    # put back
    refused_share: float = 0.2
    # Change of the images from their own last ones, over that from the other camera's, below which
    # they are in order: exchanged ones differ by motion minus disparity and motion plus disparity
    # from their own, which together is no less than twice the motion.
    least_own_change: float = 0.5


_EXCHANGE = _ExchangeRules()


@dataclass(frozen=True, slots=True)
class MatchCounts:
    """How many points of a frame match, with disparities of either sign."""

    points: int
    positive: int
    negative: int


class ExchangeDetector(ImageCheck):
    """Compares the images of consecutive frames."""

    def __init__(self, probe: RowProbe) -> None:
        super().__init__()
        self._probe = probe
        # left and right, sparsely sampled, in their right order
        self._last: tuple[Image, Image] | None = None
        self._last_halves: tuple[Image, Image] | None = None  # likewise, at half resolution
        self._since: int | None = None  # first frame of a run of exchanged ones
        # disparities are negative, and were so after a pair in order whose depths they agree with
        self._right_turned = False
        # the matches of the last frame contradicted each other, so matches are counted in any case
        self.suspicious = False

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images in their right order, or left out where they do not fit each other."""
        if not (images.right_usable and images.left_usable):
            return images
        left, right = images.halves
        exchanged = self._since is not None
        order = self.order(
            images.index,
            left,
            right,
            lambda: self._count(images, exchanged=exchanged),
            suspicious=self.suspicious,
        )
        if order == "refused":
            return images.marked(skipped=True)
        return images if order == "given" else images.exchanged()

    def _count(self, images: FrameImages, *, exchanged: bool) -> MatchCounts:
        """Count matches of either sign.

        Those with a positive disparity are not counted where those with a negative one decide:
        while the images were not `exchanged` in the last frame, too few of these leave them in
        order.
        """
        left, right = images.halves
        points = self._probe.corners(left)
        negative = self._probe.negative(left, right, points)
        if not exchanged and negative < _EXCHANGE.refused_share * len(points):
            return MatchCounts(len(points), 0, negative)
        return MatchCounts(len(points), self._probe.positive(left, right, points), negative)

    def order(
        self,
        index: int,
        left: Image,
        right: Image,
        count: Callable[[], MatchCounts],
        *,
        suspicious: bool,
    ) -> Order:
        """Return whether the images (H/2, W/2) of a frame are to be used as given, exchanged, or
        not at all.

        Args:
            index: frame number.
            left: left image as given, at half resolution.
            right: right image as given.
            count: counts matches; called where the images look exchanged.
            suspicious: whether to count in any case, as the images of the last frame contradicted
                each other.
        """
        now: tuple[Image, Image] = (_thumbnail(left), _thumbnail(right))
        order: Order = "given"
        if (
            suspicious
            or self._since is not None
            or (self._last is not None and _look_exchanged(now, self._last))
        ):
            order = _judge(count(), "given" if self._since is None else "exchanged")
            self._right_turned = order != "given" and (
                self._right_turned or self._depths_agree(left, right)
            )
            if self._right_turned:
                order = "given"
        if order != "refused":
            self._last = now if order == "given" else now[::-1]
            if order == "given":
                self._last_halves = (left, right)
            else:
                self._last_halves = (right, left)
        self._report(index, order)
        return order

    def _depths_agree(self, left: Image, right: Image) -> bool:
        """Whether the depths of a pair are those of the pair before, which was in order: then
        disparities are negative as the right camera has turned.
        """
        if self._last_halves is None or self._since is not None:
            return False
        from vio.guard.depth_order import keeps_depth_order  # it loads descriptors

        return keeps_depth_order(self._last_halves, (left, right))

    def _report(self, index: int, order: Order) -> None:
        if order == "given":
            if self._since is not None:
                self._found.append(
                    ended("images-exchanged", index, "left and right images are in order again")
                )
            self._since = None
        elif self._since is None:
            self._since = index
            done = "they are put back" if order == "exchanged" else "the frames are skipped"
            text = (
                "left and right images are exchanged from here on, as they match "
                f"with negative disparities only; {done}"
            )
            self._found.append(begun("images-exchanged", index, text))


def _look_exchanged(now: tuple[Image, Image], last: tuple[Image, Image]) -> bool:
    """Whether each image is rather like the other camera's last one."""
    own = [image_change(a, b) for a, b in zip(now, last, strict=True)]
    other = [image_change(a, b) for a, b in zip(now, last[::-1], strict=True)]
    if sum(own) < _EXCHANGE.least_own_change * sum(other):
        return False
    # The motion shifts both images alike; or it shifts them by less than the disparity does.
    unlike = abs(own[0] - own[1]) > abs(other[0] - other[1])
    return unlike or sum(own) > sum(other)


def _thumbnail(image: Image) -> Image:
    """A small copy of an image, averaged over areas."""
    # twice over two by two pixels, which OpenCV averages many times as fast as other areas
    for _ in range(_EXCHANGE.halvings):
        width, height = (size // 2 for size in image.shape[::-1])
        if width < _EXCHANGE.thumbnail[0] or height < _EXCHANGE.thumbnail[1]:
            break
        whole = image[: 2 * height, : 2 * width]
        image = np.asarray(
            cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return np.asarray(
        cv2.resize(image, _EXCHANGE.thumbnail, interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


def _judge(found: MatchCounts, likely: Order) -> Order:
    """Decide by matches about a frame that looks exchanged; where they are too few, the decision
    is as before.
    """
    if (
        found.points < _EXCHANGE.min_points
        or max(found.negative, found.positive) < _EXCHANGE.refused_share * found.points
    ):
        return likely
    if found.negative < 2 * found.positive:
        return "given"
    if found.negative >= _EXCHANGE.exchanged_share * found.points:
        return "exchanged"
    return "refused"
