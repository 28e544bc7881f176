"""The damping of nonlinear least squares by Levenberg and Marquardt, for any state and any way to
solve for a step.

Loops that do not use it, and why:

- Compiled loops (`filters/track_loops`, `frontend/align`, `frontend/outliers`): machine code calls
  no Python function for a step or a cost.
- Undamped steps that begin at a linear solution, or at the last frame's (`filters/alignment`,
  `mono_start`, `imu_jump`, `step_by_images`, `frame_update`, `vislam`, `mapping/loop_geometry`,
  `calibration/stereo_field`, `targets/blurred`, `offline/refine`, `offline/points`): robust weights
  change from step to step, so that a cost of the last ones does not judge a step.
- Graduated weights (`mapping/pose_graph`, `earth/alignment`): each step has another cost.
- `calibration/gyro` and `calibration/stereo` fit once and use `scipy.optimize.least_squares`.

Everywhere, `steps` is how many are made, and `max_steps` how many at most.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from vio.dataclass import dataclass
from vio.numerics.kinds import Tolerance

State = TypeVar("State")
_LARGER: Tolerance[float] = (
    10.0  # after a step that raises the cost, and smaller by as much after one that does not
)


@dataclass(slots=True)
class Damping:
    """How much of the diagonal of the normal equations is added to them.

    Reference: Marquardt, An algorithm for least-squares estimation of nonlinear parameters, SIAM
    Journal (1963).
    """

    largest: float  # beyond it no step is shorter: rounding is all that is left
    smallest: float = 1e-9
    value: float = 1e-4  # for the next step; at first, nearly that of Gauss and Newton

    def step(
        self, moved: Callable[[float], State], cost: Callable[[State], float], before: float
    ) -> tuple[State, float] | None:
        """Return a state whose cost is no larger, and that cost; None: no step leads to one.

        Args:
            moved: the state after the step that a damping gives.
            cost: of a state; infinite where it has none.
            before: cost of the present state, finite.
        """
        while True:
            state = moved(self.value)
            after = cost(state)
            if after <= before:
                self.value = max(self.value / _LARGER, self.smallest)
                return state, after
            self.value *= _LARGER
            if self.value > self.largest:
                return None
