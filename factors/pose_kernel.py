"""Exponential and logarithm of SE(3) of many poses, and damped steps to minima, compiled.

As GTSAM's, of twists (rotation [rad], translation [m]). Below a small angle, series of two terms
are as exact as the closed formulas.
"""

import math

import numpy as np

from factors.compiled import compiled

_SMALL_ANGLE = 1e-2  # rad
_LEAST = float(np.finfo(np.float64).tiny)
DAMPING, MAX_STEPS = 1e-5, 50
"""Of a fit: damping relative to the diagonal, at first; steps at most, of which 4 to 8 are enough
with a start in the right basin."""
_MIN_DAMPING = 1e-12  # with less, frames that leave a direction free would be singular
MAX_DAMPING = 1e6
"""Relative to the diagonal: a fit that asks for more has failed."""
_SMALL_STEP = 1e-10  # rad, m: below what residuals of 1e-6 px resolve


@compiled()
def exponential_times(twists, T):  # type: ignore[no-untyped-def]
    """Multiply (f, 4, 4) transforms, in place, by exp(twist) from the left, of (f, 6) twists."""
    for i in range(len(twists)):
        move(1.0, twists[i], T[i], T[i])


@compiled(part=True)
def move(sign, twist, T, out):  # type: ignore[no-untyped-def]
    """Fill in ``out`` with exp(sign twist) T; it may be T itself."""
    x, y, z = sign * twist[0], sign * twist[1], sign * twist[2]
    u, v, w = sign * twist[3], sign * twist[4], sign * twist[5]
    angle = math.sqrt(x * x + y * y + z * z)
    squared = angle * angle
    if angle < _SMALL_ANGLE:
        first = 1.0 - squared / 6.0 * (1.0 - squared / 20.0)
        second = 0.5 - squared / 24.0 * (1.0 - squared / 30.0)
        third = 1.0 / 6.0 - squared / 120.0
    else:
        first, half = math.sin(angle) / angle, math.sin(angle / 2.0) / angle
        second, third = 2.0 * half * half, (1.0 - first) / squared
    # R = I + first [w]x + second [w]x^2,  t = (I + second [w]x + third [w]x^2) v.
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    p, q, r = first * x, first * y, first * z
    r00, r01, r02 = 1.0 - second * (y * y + z * z), xy - r, xz + q
    r10, r11, r12 = xy + r, 1.0 - second * (x * x + z * z), yz - p
    r20, r21, r22 = xz - q, yz + p, 1.0 - second * (x * x + y * y)
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    for column in range(len(T)):
        t0, t1, t2 = T[0, column], T[1, column], T[2, column]
        out[0, column] = r00 * t0 + r01 * t1 + r02 * t2
        out[1, column] = r10 * t0 + r11 * t1 + r12 * t2
        out[2, column] = r20 * t0 + r21 * t1 + r22 * t2
        out[3, column] = T[3, column]
    out[0, 3] += u + second * a + third * (y * c - z * b)
    out[1, 3] += v + second * b + third * (z * a - x * c)
    out[2, 3] += w + second * c + third * (x * b - y * a)


@compiled(part=True)
def _rotation_vector(R):  # type: ignore[no-untyped-def]
    """The logarithm of the rotation of a (4, 4) transform, by its quaternion."""
    q, trace = np.empty(4), R[0, 0] + R[1, 1] + R[2, 2]
    i = 1 if R[1, 1] > R[0, 0] else 0
    i = 2 if R[2, 2] > R[i, i] else i
    if trace > R[i, i]:
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 - trace + 2.0 * R[i, i]
        q[j], q[k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    length = 2.0 * math.atan2(sine, abs(q[3])) / sine if sine > 0.0 else 0.0
    length = -length if q[3] < 0.0 else length
    return length * q[0], length * q[1], length * q[2]


@compiled()
def logarithms(steps):  # type: ignore[no-untyped-def]
    """(f, 6) twists of (f, 4, 4) transforms."""
    out = np.empty((len(steps), 6))
    for i in range(len(steps)):
        x, y, z = _rotation_vector(steps[i])
        u, v, w = steps[i, 0, 3], steps[i, 1, 3], steps[i, 2, 3]
        angle = math.sqrt(x * x + y * y + z * z)
        if angle < _SMALL_ANGLE:
            inward = 1.0 / 12.0 + angle * angle / 720.0
        else:
            inward = (1.0 - angle / 2.0 / math.tan(angle / 2.0)) / (angle * angle)
        # The inverse of the left Jacobian: I - [w]x / 2 + inward [w]x^2.
        a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
        out[i, 0], out[i, 1], out[i, 2] = x, y, z  # an assignment to out[i] compiles for seconds
        out[i, 3] = u - a / 2.0 + inward * (y * c - z * b)
        out[i, 4] = v - b / 2.0 + inward * (z * a - x * c)
        out[i, 5] = w - c / 2.0 + inward * (x * b - y * a)
    return out


@compiled(part=True)
def judge(sums, best, work, damping, tolerance):  # type: ignore[no-untyped-def]
    """Judge a step of Levenberg-Marquardt: taken where the cost does not rise.

    Args:
        sums: (2, 8, 7) of both poses: upper triangle of H, b in the last column, and c below.
        best: which pose it is from; it is to the other one.
        work: of :func:`solve_damped`.
        damping: as it was.
        tolerance: relative decrease of the cost at which the fit is done.

    Returns:
        Which pose is the best; the next damping; whether the fit is done.
    """
    gain, size = sums[best, 7, 0] - sums[1 - best, 7, 0], 0.0
    for i in range(work.shape[1]):
        size = max(size, abs(work[6, i]))
    is_done = size < _SMALL_STEP or (gain >= 0.0 and gain <= tolerance * sums[best, 7, 0])
    damping = max(damping * (0.1 if gain >= 0.0 else 10.0), _MIN_DAMPING)
    return 1 - best if gain >= 0.0 else best, damping, is_done or not damping < MAX_DAMPING


@compiled(part=True)
def solve_damped(sums, damping, work):  # type: ignore[no-untyped-def]
    """Fill in ``work[6]``, of (7, 6), with the step to the minimum of a cost, by Cholesky's root.

    The diagonal is that much larger; a direction that is free gets no step.
    """
    n, step = work.shape[1], work[6]
    for row in range(n):
        step[row] = -sums[row, n]
        for column in range(row + 1):
            rest = sums[column, row]
            if column == row:
                rest *= 1.0 + damping
            for m in range(column):
                rest -= work[row, m] * work[column, m]
            rest = rest / work[column, column] if column < row else math.sqrt(max(rest, _LEAST))
            work[row, column] = rest
            if column < row:
                step[row] -= rest * step[column]
        step[row] /= work[row, row]
    for behind in range(n):
        row = n - 1 - behind
        for m in range(row + 1, n):
            step[row] -= work[m, row] * step[m]
        step[row] /= work[row, row]
