"""Left and right pixels that are exchanged: most disparities are negative."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vio.errors import DataError
from vio.findings import Finder, begun, ended
from vio.guard.match_check import Hysteresis
from vio.guard.probe import MIN_SIGNED_PX
from vio.records import Observations


@dataclass(frozen=True, slots=True)
class _ExchangeRules:
    """When left and right pixels count as exchanged."""

    min_matches: int = 20  # with fewer, a frame tells nothing
    # share of negative disparities that proves an exchange; usual is below 0.02
    exchanged_share: float = 0.6
    frames: int = 3  # the first ones that say so make the recording a wrong one


_EXCHANGE = _ExchangeRules()
_CODE = "images-exchanged"


class ExchangedMatches(Finder):
    """Puts exchanged pixels back before the other checks, and refuses recordings that begin with
    them.
    """

    def __init__(self) -> None:
        super().__init__()
        self._state = Hysteresis(to_report=1, to_end=1, blind=40)
        self._in_order = False  # some frame was

    def inspect(self, seen: Observations) -> Observations:
        """Compare left and right columns of a frame, and return them in order.

        Raises:
            DataError: the first frames are exchanged.
        """
        matched = seen.z[seen.has_right]
        if len(matched) < _EXCHANGE.min_matches:
            return self._put_back(seen)
        negative = int((matched[:, 2] - matched[:, 0] >= MIN_SIGNED_PX).sum())
        self._judge(seen.frame_index, negative, len(matched))
        return self._put_back(seen)

    def _judge(self, index: int, negative: int, matches: int) -> None:
        exchanged = negative >= _EXCHANGE.exchanged_share * matches
        self._in_order |= not exchanged
        state = self._state
        state.show(index, exchanged)
        if not self._in_order and state.frames >= _EXCHANGE.frames:
            raise DataError(
                f"frame {index}: left and right pixels look exchanged ({negative} of {matches} "
                f"disparities are negative, in {_EXCHANGE.frames} frames); exchange the columns of the "
                "features, or the cameras' calibration"
            )
        if self._in_order and state.to_report():
            text = (
                f"left and right pixels are exchanged from here on, as {negative} of "
                f"{matches} disparities are negative; they are put back"
            )
            figures = {"negative_share": negative / matches}
            self._found.append(begun(_CODE, index, text, figures=figures))
        if state.ends():
            self._found.append(ended(_CODE, index, "left and right pixels are in order again"))

    def _put_back(self, seen: Observations) -> Observations:
        """Return the pixels in their order; features of one image alone would be of the wrong
        one.
        """
        if self._state.since is None:
            return seen
        return replace(seen, z=seen.z[:, [2, 3, 0, 1]].copy()).take(seen.has_right)
