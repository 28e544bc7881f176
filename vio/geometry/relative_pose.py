"""A motion with its covariance: of a camera or a body from one of its poses to another."""

from __future__ import annotations

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse


@dataclass(frozen=True, slots=True)
class RelativePose:
    """The motion between two poses of one frame."""

    T_i_j: FloatArray  # (4, 4) maps the frame's second pose j to its first one i
    covariance: FloatArray  # (6, 6) of xi in T_i_j = T_hat exp(xi), [rho; phi], m and rad

    def then(self, other: RelativePose) -> RelativePose:
        """Return the motion from i to k, of those from i to j and, independent of it, from j to
        k.
        """
        A = se3_adjoint(se3_inverse(other.T_i_j))
        return RelativePose(self.T_i_j @ other.T_i_j, A @ self.covariance @ A.T + other.covariance)

    def inverse(self) -> RelativePose:
        """Return the motion from j to i."""
        A = se3_adjoint(self.T_i_j)
        return RelativePose(se3_inverse(self.T_i_j), A @ self.covariance @ A.T)

    def seen_by(self, T_c_b: FloatArray) -> RelativePose:
        """Return the motion of a frame c that is fixed to this one b at `T_c_b` (4, 4)."""
        A = se3_adjoint(T_c_b)
        return RelativePose(T_c_b @ self.T_i_j @ se3_inverse(T_c_b), A @ self.covariance @ A.T)
