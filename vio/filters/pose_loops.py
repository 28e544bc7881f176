"""The compiled loops over the poses of the window and over the IMU's samples, behind `window` and
`navigation`.

Shapes: N clones, M points, K times of an integration. Each loop changes or fills the arrays that
come last. `tests/numpy_twins.py` holds the same in NumPy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, solve_positive
from vio.records import IntArray


@compiled
def _sinc_terms(squared: float) -> tuple[float, float, float]:
    """Return `sin(a)/a`, `(1 - cos a)/a^2` and `(a - sin a)/a^3` of a squared angle, as
    `vio.geometry.lie` does.
    """
    if squared < 1e-4:  # cancellation in the closed forms
        a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
        b = 0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0))
        return a, b, 1.0 / 6.0 - squared / 120.0 * (1.0 - squared / 42.0 * (1.0 - squared / 72.0))
    angle = np.sqrt(squared)
    half = np.sin(angle / 2.0)
    return (
        np.sin(angle) / angle,
        2.0 * half * half / squared,
        (angle - np.sin(angle)) / (angle * squared),
    )


@compiled
def _turned(
    x: float, y: float, z: float, first: float, second: float, v: FloatArray
) -> tuple[float, float, float]:
    """Return `(I + first W + second W W) v`, with W the skew-symmetric matrix of (x, y, z)."""
    cx = y * v[2] - z * v[1]
    cy = z * v[0] - x * v[2]
    cz = x * v[1] - y * v[0]
    dx = y * cz - z * cy
    dy = z * cx - x * cz
    dz = x * cy - y * cx
    return (
        v[0] + first * cx + second * dx,
        v[1] + first * cy + second * dy,
        v[2] + first * cz + second * dz,
    )


@compiled
def move_points(phi: FloatArray, xi: FloatArray, p: FloatArray) -> None:
    """Replace points or velocities (M, 3) by `exp(phi) p + J_l(phi) xi`, with one phi (3,) and
    xi (M, 3).
    """
    x = phi[0]
    y = phi[1]
    z = phi[2]
    a, b, c = _sinc_terms(x * x + y * y + z * z)
    for m in range(len(p)):
        px, py, pz = _turned(x, y, z, a, b, p[m])
        qx, qy, qz = _turned(x, y, z, b, c, xi[m])
        p[m, 0] = px + qx
        p[m, 1] = py + qy
        p[m, 2] = pz + qz


@compiled
def camera_poses(T_cam0_imu: FloatArray, T_world_imu: FloatArray, out: FloatArray) -> None:
    """Write `T_cam0_imu T_world_imu^-1` (N, 4, 4)."""
    for n in range(len(out)):
        T = T_world_imu[n]
        for i in range(3):
            out[n, i, 3] = T_cam0_imu[i, 3]
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += T_cam0_imu[i, k] * T[j, k]
                out[n, i, j] = total
                out[n, i, 3] -= total * T[j, 3]
            out[n, 3, i] = 0.0
        out[n, 3, 3] = 1.0


@compiled
def add_extrinsic_moves(
    T_world_imu: FloatArray, now: FloatArray, eta: FloatArray, moves: FloatArray
) -> None:
    """Add how the extrinsics' error eta (6,) moves the body's poses (N, 4, 4),
    `Ad(T T_now^-1) eta`: moves (N, 6).
    """
    for n in range(len(moves)):
        T = T_world_imu[n]  # R' eta of the present pose, then by that of the clone
        t = moves[n]
        turned = np.zeros(6)
        for i in range(3):
            for j in range(3):
                turned[i] += now[j, i] * (eta[j] - _cross(now[:, 3], eta[3:], j))
                turned[3 + i] += now[j, i] * eta[3 + j]
        rho = np.zeros(3)
        phi = np.zeros(3)
        for i in range(3):
            for j in range(3):
                rho[i] += T[i, j] * turned[j]
                phi[i] += T[i, j] * turned[3 + j]
        for i in range(3):
            t[i] += rho[i] + _cross(T[:, 3], phi, i)
            t[3 + i] += phi[i]


@compiled
def _cross(a: FloatArray, b: FloatArray, i: int) -> float:
    """One entry of the cross product."""
    j = (i + 1) % 3
    k = (i + 2) % 3
    return a[j] * b[k] - a[k] * b[j]


@compiled
def move_earlier_velocities(
    gravity: FloatArray,
    ages: FloatArray,
    R: FloatArray,
    error: FloatArray,
    entries: IntArray,
    velocities: FloatArray,
) -> None:
    """Move velocities (N, 3) of the past by a present error (15 + I,), with the entries (I, 3) of
    the IMU's terms, see `ImuMotion.corrected_earlier`.
    """
    xi = np.empty(velocities.shape)
    last = velocities[len(ages) - 1]
    by_terms = np.empty(3)
    for n in range(len(ages)):
        for i in range(3):
            by_bias = R[n, i, 0] * error[12] + R[n, i, 1] * error[13] + R[n, i, 2] * error[14]
            xi[n, i] = error[6 + i] + ages[n] * (by_bias - _cross(gravity, error[3:6], i))
        if len(entries):
            by_terms[:] = 0.0
            for m in range(len(entries)):
                if entries[m, 0] == 0:
                    impulse = 0.0  # of the mean force over the time since, along that axis
                    for i in range(3):
                        change = last[i] - velocities[n, i] - ages[n] * gravity[i]
                        impulse += R[n, i, entries[m, 2]] * change
                    by_terms[entries[m, 1]] += impulse * error[15 + m]
            for i in range(3):
                for j in range(3):
                    xi[n, i] -= R[n, i, j] * by_terms[j]
    move_points(error[3:6], xi, velocities)


@compiled
def write_terms_of_rate(
    M_gyro: FloatArray, rate: FloatArray, entries: IntArray, out: FloatArray
) -> None:
    """Write how a calibrated rate (3,), bias included, moves with the IMU's terms (3, I): (A2), at
    the reading that `M_gyro` (3, 3) takes to it.
    """
    M = M_gyro
    reading = np.empty(3)
    scale = 0.0
    for i in range(3):  # the inverse by the cross products of M's columns
        j = (i + 1) % 3
        k = (i + 2) % 3
        reading[i] = 0.0
        for r in range(3):
            s = (r + 1) % 3
            t = (r + 2) % 3
            cofactor = M[s, j] * M[t, k] - M[t, j] * M[s, k]
            reading[i] += cofactor * rate[r]
            if i == 0:
                scale += cofactor * M[r, 0]
    for m in range(len(entries)):
        for i in range(3):
            out[i, m] = 0.0
        if entries[m, 0] == 1:
            out[entries[m, 1], m] = reading[entries[m, 2]] / scale


@compiled
def shrink_by_noise(covariance: FloatArray, noise_only: float, halves: FloatArray) -> None:
    """Shrink each half (3,) of a vector (6,) by the part of its squared length that noise alone may
    make, (C3).

    The length is in standard deviations of its covariance (6, 6); noise makes `noise_only` of it.
    """
    C = np.empty((3, 3))
    y = np.empty(3)
    for first in (0, 3):
        for i in range(3):
            y[i] = halves[first + i]
            for j in range(3):
                C[i, j] = covariance[first + i, first + j]
            C[i, i] += 1e-18
        solve_positive(C, y)
        squared = halves[first] * y[0] + halves[first + 1] * y[1] + halves[first + 2] * y[2]
        for i in range(3):
            halves[first + i] *= np.sqrt(max(1.0 - noise_only / max(squared, 1e-9), 0.0))


@compiled
def take_rows(P: FloatArray, rows: IntArray, out: FloatArray) -> None:
    """Write the chosen rows and columns (K, K) of a matrix."""
    for i in range(len(rows)):
        for j in range(len(rows)):
            out[i, j] = P[rows[i], rows[j]]


@compiled
def take_blocks(P: FloatArray, out: FloatArray) -> None:
    """Write each point's block with the last S errors (M, 3 + S, 3 + S) of the covariance of all
    (3M + S, same).
    """
    points = 3 * len(out)
    for m in range(len(out)):
        for i in range(out.shape[1]):
            row = 3 * m + i if i < 3 else points + i - 3
            for j in range(out.shape[1]):
                out[m, i, j] = P[row, 3 * m + j if j < 3 else points + j - 3]


@compiled
def take_since_first(P: FloatArray, first: int, attitude: int, out: FloatArray) -> None:
    """Write the covariance (6N, 6N) of poses, from row `first` of P on, in the world that is
    reported: (N14).

    `attitude` is the row of the error of the first attitude.
    """
    for i in range(len(out)):
        a = attitude + i % 6 - 3
        for j in range(len(out)):
            b = attitude + j % 6 - 3
            out[i, j] = P[first + i, first + j]
            if i % 6 >= 3:
                out[i, j] -= P[a, first + j]
            if j % 6 >= 3:
                out[i, j] -= P[first + i, b]
            if i % 6 >= 3 and j % 6 >= 3:
                out[i, j] += P[a, b]


@compiled
def _place_after(i: int, at: int, k: int) -> int:
    """Return the row that an error has once k others are inserted at a row."""
    return i if i < at else i + k


@compiled
def _spread(P: FloatArray, at: int, k: int, out: FloatArray) -> None:
    """Write a covariance (D, D) into a larger one, with room for k errors at a row."""
    for i in range(len(P)):
        row = _place_after(i, at, k)
        for j in range(len(P)):
            out[row, _place_after(j, at, k)] = P[i, j]


@compiled
def insert_rows(P: FloatArray, at: int, J: FloatArray, noise: FloatArray, out: FloatArray) -> None:
    """Write a covariance (D + k, D + k) with errors `J error + noise` at a row, from that of the
    others (D, D).

    J is (k, m) of the first m errors. Where it is the identity, the new rows are exact copies.
    """
    D = len(P)
    k = len(J)
    _spread(P, at, k, out)
    for a in range(k):
        for j in range(D):
            beside = 0.0
            below = 0.0
            for m in range(J.shape[1]):
                if J[a, m] != 0.0:
                    beside += J[a, m] * P[m, j]
                    below += J[a, m] * P[j, m]
            column = _place_after(j, at, k)
            out[at + a, column] = beside
            out[column, at + a] = below
    for a in range(k):
        for b in range(k):
            total = 0.0
            for m in range(J.shape[1]):
                if J[b, m] != 0.0:
                    total += J[b, m] * out[at + a, _place_after(m, at, k)]
            out[at + a, at + b] = total + noise[a, b]


@compiled
def append_rows(
    P: FloatArray, AP: FloatArray, A: FloatArray, blocks: FloatArray, out: FloatArray
) -> None:
    """Write a covariance (D + n, D + n) with errors `A error + noise` of points, (n, D), behind the
    others (D, D).

    AP is `A P`; blocks (n / 3, 3, 3) are the noise's covariances.
    """
    D = len(P)
    n = len(A)
    for i in range(D):
        for j in range(i + 1):
            out[i, j] = out[j, i] = 0.5 * (P[i, j] + P[j, i])
    for a in range(n):
        for j in range(D):
            out[D + a, j] = out[j, D + a] = AP[a, j]
        for b in range(a + 1):
            total = 0.0
            for j in range(D):
                if A[b, j] != 0.0:
                    total += AP[a, j] * A[b, j]
            total += blocks[a // 3, a % 3, b % 3] if a // 3 == b // 3 else 0.0
            out[D + a, D + b] = out[D + b, D + a] = total


class ImuNoise(NamedTuple):
    """Noise of IMU readings over K times, accelerometer first."""

    densities: FloatArray  # (2,)
    walks: FloatArray  # (2,) of the biases of gyro and accelerometer
    hidden: FloatArray  # (2, K - 1) what gaps hide, variances


class TermColumns(NamedTuple):
    """How errors of an IMU's scales and misalignments move the state over an integration: (A3)."""

    levers: FloatArray  # (K, 6) readings `[gyro, accel]` as the terms multiply them
    entries: IntArray  # (I, 3) of each term: sensor (0 accelerometer, 1 gyro), row, column
    columns: FloatArray  # (15, I) added to


class ImuStep(NamedTuple):
    """What an integration moves and writes."""

    T: FloatArray  # (4, 4) pose, moved
    v: FloatArray  # (3,) velocity, moved
    turned: FloatArray  # (3,) rotation, added to
    Phi: FloatArray  # (15, 15) an identity at first
    Q_parts: FloatArray  # (2, 15, 15) noise of accelerometer and gyro, zero at first
    Q: FloatArray  # (15, 15) their sum, with the walks of the biases


@compiled
def _add_noise(
    R: FloatArray,
    p: FloatArray,
    v: FloatArray,
    gravity: FloatArray,
    span: tuple[float, float],
    variances: tuple[float, float],
    out: ImuStep,
) -> None:
    """Add what one step brings to Phi and Q_parts: (N3), (N4).

    `span` is its duration, and how long before the end its middle is (s); the variances are those
    of the integrals of accelerometer and gyro over it.
    """
    dt, left = span
    accel2, gyro2 = variances
    Phi = out.Phi
    Q_parts = out.Q_parts
    # How noise and bias errors of gyro and accelerometer enter [rho phi xi_v] (9, 6) there, carried
    # to the end.
    enters = np.empty((9, 6))
    lever = np.empty(3)
    swing = np.empty(3)
    for i in range(3):
        swing[i] = v[i] + left * gravity[i]
        lever[i] = p[i] + left * (v[i] + 0.5 * left * gravity[i])
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        for c in range(3):
            enters[i, c] = lever[k] * R[j, c] - lever[j] * R[k, c]
            enters[3 + i, c] = -R[i, c]
            enters[6 + i, c] = swing[k] * R[j, c] - swing[j] * R[k, c]
            enters[i, 3 + c] = -left * R[i, c]
            enters[3 + i, 3 + c] = 0.0
            enters[6 + i, 3 + c] = -R[i, c]
    for i in range(9):
        for j in range(6):
            Phi[i, 9 + j] += enters[i, j] * dt
        for j in range(9):
            Q_parts[0, i, j] += accel2 * (
                enters[i, 3] * enters[j, 3]
                + enters[i, 4] * enters[j, 4]
                + enters[i, 5] * enters[j, 5]
            )
            Q_parts[1, i, j] += gyro2 * (
                enters[i, 0] * enters[j, 0]
                + enters[i, 1] * enters[j, 1]
                + enters[i, 2] * enters[j, 2]
            )


@compiled
def _add_terms(
    R: FloatArray,
    new: FloatArray,
    p: FloatArray,
    v: FloatArray,
    gravity: FloatArray,
    span: tuple[float, float],
    levers: FloatArray,
    entries: IntArray,
    columns: FloatArray,
) -> None:
    """Add what one step brings to the columns (15, I) of the IMU's terms: (A3).

    Attitudes before and after it, position and velocity in its middle, `span` as in `_add_noise`,
    and the levers (2, 6) at both ends.
    """
    dt, left = span
    by = np.empty(3)
    lever = np.empty(3)
    swing = np.empty(3)
    for i in range(3):
        swing[i] = v[i] + left * gravity[i]
        lever[i] = p[i] + left * (v[i] + 0.5 * left * gravity[i])
    for n in range(len(entries)):
        row = entries[n, 1]
        if entries[n, 0] == 0:
            before = levers[0, 3 + entries[n, 2]]
            after = levers[1, 3 + entries[n, 2]]
            for i in range(3):
                by[i] = 0.5 * (R[i, row] * before + new[i, row] * after) * dt
                columns[i, n] += left * by[i]
                columns[6 + i, n] += by[i]
        else:
            mean = 0.5 * (levers[0, entries[n, 2]] + levers[1, entries[n, 2]])
            for i in range(3):
                by[i] = 0.5 * (R[i, row] + new[i, row]) * mean * dt
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                columns[i, n] += lever[j] * by[k] - lever[k] * by[j]
                columns[3 + i, n] += by[i]
                columns[6 + i, n] += swing[j] * by[k] - swing[k] * by[j]


@compiled
def integrate(
    times_ns: FloatArray,
    readings: FloatArray,
    bias: FloatArray,
    gravity: FloatArray,
    noise: ImuNoise,
    terms: TermColumns,
    out: ImuStep,
) -> None:
    """Integrate readings (K, 6) `[gyro, accel]` at times (K,), equations (N1) to (N4)."""
    T = out.T
    v = out.v
    densities = noise.densities
    R = T[:3, :3].copy()
    p = T[:3, 3].copy()
    new = np.empty((3, 3))
    phi = np.empty(3)
    force = np.empty(3)
    pm = np.empty(3)
    vm = np.empty(3)
    end = times_ns[-1]
    for k in range(len(times_ns) - 1):
        dt = (times_ns[k + 1] - times_ns[k]) * 1e-9
        for i in range(3):
            phi[i] = (0.5 * (readings[k, i] + readings[k + 1, i]) - bias[i]) * dt
            out.turned[i] += phi[i]
        a, b, _ = _sinc_terms(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
        for i in range(3):  # R exp(phi) is the transpose of exp(-phi) R'
            new[i, 0], new[i, 1], new[i, 2] = _turned(-phi[0], -phi[1], -phi[2], a, b, R[i])
        _write_acceleration(R, new, readings[k : k + 2], bias, gravity, force)
        for i in range(3):
            pm[i] = p[i]
            vm[i] = v[i]
            p[i] += v[i] * dt + 0.5 * force[i] * dt * dt
            v[i] += force[i] * dt
            pm[i] = 0.5 * (pm[i] + p[i])
            vm[i] = 0.5 * (vm[i] + v[i])
        left = (end - 0.5 * (times_ns[k] + times_ns[k + 1])) * 1e-9
        accel2 = densities[0] ** 2 * dt + noise.hidden[0, k]
        gyro2 = densities[1] ** 2 * dt + noise.hidden[1, k]
        _add_noise(R, pm, vm, gravity, (dt, left), (accel2, gyro2), out)
        if len(terms.entries):
            _add_terms(
                R,
                new,
                pm,
                vm,
                gravity,
                (dt, left),
                terms.levers[k : k + 2],
                terms.entries,
                terms.columns,
            )
        for i in range(3):
            for j in range(3):
                R[i, j] = new[i, j]
    for i in range(3):
        T[i, 3] = p[i]
        for j in range(3):
            T[i, j] = R[i, j]
    _finish_growth(end * 1e-9, gravity, noise.walks, out)


@compiled
def _write_acceleration(
    R: FloatArray,
    new: FloatArray,
    readings: FloatArray,
    bias: FloatArray,
    gravity: FloatArray,
    out: FloatArray,
) -> None:
    """Write the mean acceleration (3,) in the world between two readings (2, 6), at attitudes (3,
    3) before and after.
    """
    for i in range(3):
        out[i] = gravity[i]
        for j in range(3):
            before = readings[0, 3 + j] - bias[3 + j]
            after = readings[1, 3 + j] - bias[3 + j]
            out[i] += 0.5 * (R[i, j] * before + new[i, j] * after)


@compiled
def _finish_growth(total: float, gravity: FloatArray, walks: FloatArray, out: ImuStep) -> None:
    """Write what depends on the whole time (s) alone into Phi, and add up Q."""
    Phi = out.Phi
    Q = out.Q
    for i in range(15):
        for j in range(15):
            Q[i, j] = out.Q_parts[0, i, j] + out.Q_parts[1, i, j]
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        Phi[i, 6 + i] = total  # (N2), the same for every state, which is the filter's point
        Phi[i, 3 + j] = -(0.5 * total**2) * gravity[k]
        Phi[i, 3 + k] = (0.5 * total**2) * gravity[j]
        Phi[6 + i, 3 + j] = -total * gravity[k]
        Phi[6 + i, 3 + k] = total * gravity[j]
        Q[9 + i, 9 + i] = walks[0] ** 2 * total
        Q[12 + i, 12 + i] = walks[1] ** 2 * total


@compiled
def calibrate(raw: FloatArray, entries: IntArray, terms: FloatArray, out: FloatArray) -> None:
    """Write readings (K, 6) `[gyro, accel]` with scale and misalignment taken out: (A1), of terms
    (I,) and their entries (I, 3).
    """
    for k in range(len(raw)):
        for i in range(6):
            out[k, i] = raw[k, i]
        for n in range(len(entries)):
            first = 3 - 3 * entries[n, 0]
            out[k, first + entries[n, 1]] += terms[n] * raw[k, first + entries[n, 2]]


@compiled
def shrink_to_signal(
    raw: FloatArray, usual: FloatArray, noise_energy: FloatArray, out: FloatArray
) -> None:
    """Write readings (K, 6) `[gyro, accel]`, their deviation from the usual one (6,) shrunk by
    their noise: (A5).

    `noise_energy` (2,): of the mean deviation of gyro and accelerometer, below which nothing is
    left.
    """
    n = len(raw)
    for part in range(2):
        squared = 0.0
        for i in range(3 * part, 3 * part + 3):
            mean = 0.0
            for k in range(n):
                mean += raw[k, i] - usual[i]
            squared += (mean / n) ** 2
        kept = np.sqrt(max(1.0 - noise_energy[part] / max(squared, 1e-300), 0.0))
        for k in range(n):
            for i in range(3 * part, 3 * part + 3):
                out[k, i] = usual[i] + kept * (raw[k, i] - usual[i])


@compiled
def interpolate(cuts: FloatArray, t: FloatArray, readings: FloatArray, out: FloatArray) -> None:
    """Write readings (K, 6) at times (K,) from those (S, 6) at times (S,): on straight lines,
    the ends held.
    """
    s = 0
    for k in range(len(cuts)):
        while s < len(t) and t[s] <= cuts[k]:
            s += 1
        for i in range(6):
            if s == 0 or s == len(t):
                out[k, i] = readings[min(s, len(t) - 1), i]
            else:
                slope = (readings[s, i] - readings[s - 1, i]) / (t[s] - t[s - 1])
                out[k, i] = slope * (cuts[k] - t[s - 1]) + readings[s - 1, i]


@compiled
def scale_nav(
    T_world_imu: FloatArray, T_cam0_imu: FloatArray, velocity: FloatArray, out: FloatArray
) -> None:
    """Write how a navigation state's error (15,) moves with the logarithm of the world's scale,
    equation (S1).
    """
    for i in range(3):
        out[i] = T_world_imu[i, 3]
        out[6 + i] = velocity[i]
        out[3 + i] = out[9 + i] = out[12 + i] = 0.0
        for k in range(3):
            for j in range(3):
                out[i] -= T_world_imu[i, k] * T_cam0_imu[j, k] * T_cam0_imu[j, 3]


@compiled
def lacks_samples(cuts: FloatArray, t: FloatArray, longest: float) -> bool:
    """Whether any step between cuts (K,) lies beyond the samples at times (S,), or between two
    that are far apart.
    """
    s = 0
    for k in range(len(cuts) - 1):
        middle = 0.5 * (cuts[k] + cuts[k + 1])
        while s < len(t) and t[s] < middle:
            s += 1
        if s == 0 or s == len(t) or t[s] - t[s - 1] > longest:
            return True
    return False
