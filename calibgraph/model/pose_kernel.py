"""Exponential and logarithm of SE(3), and damped steps to minima, of many poses at once, compiled.

As GTSAM's, of twists (rotation [rad], translation [m]). Below a small angle, series of two terms
are as exact as the closed formulas. Sums are those of ``factors.block``: 21 of the upper triangle
of H, 6 of b, 1 of c.
"""

import math

import numpy as np

from factors.compiled import compiled

_SMALL_ANGLE = 1e-2  # rad
_LEAST = float(np.finfo(np.float64).tiny)
_MIN_DAMPING = 1e-12  # with less, frames that leave a direction free would be singular
MAX_DAMPING = 1e6
"""Relative to the diagonal: a fit that asks for more has failed."""
_SMALL_STEP = 1e-10  # rad, m: below what residuals of 1e-6 px resolve


@compiled()
def exponential_times(twists, T, out):  # type: ignore[no-untyped-def]
    """Fill (f, 4, 4) ``out`` with exp(twist) T of (f, 6) twists and (f, 4, 4) transforms."""
    for i in range(len(twists)):
        _move(1.0, twists, i, T, i, out)


@compiled(part=True)
def _move(sign, twists, i, T, k, out):  # type: ignore[no-untyped-def]
    """Fill in ``out[i]`` with exp(sign twists[i]) T[k]."""
    x, y, z = sign * twists[i, 0], sign * twists[i, 1], sign * twists[i, 2]
    u, v, w = sign * twists[i, 3], sign * twists[i, 4], sign * twists[i, 5]
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
    for column in range(4):
        t0, t1, t2 = T[k, 0, column], T[k, 1, column], T[k, 2, column]
        out[i, 0, column] = r00 * t0 + r01 * t1 + r02 * t2
        out[i, 1, column] = r10 * t0 + r11 * t1 + r12 * t2
        out[i, 2, column] = r20 * t0 + r21 * t1 + r22 * t2
        out[i, 3, column] = 1.0 if column == 3 else 0.0  # noqa: PLR2004
    out[i, 0, 3] += u + second * a + third * (y * c - z * b)
    out[i, 1, 3] += v + second * b + third * (z * a - x * c)
    out[i, 2, 3] += w + second * c + third * (x * b - y * a)


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
def _solve_damped(sums, k, damping, work, steps, i):  # type: ignore[no-untyped-def]
    """Fill in ``steps[i]`` to the minimum of the cost of ``sums[k]``, by Cholesky's root.

    The diagonal, scaled to one, is that much larger; a direction that is free gets no step.
    """
    place = 0
    for row in range(6):
        for column in range(row, 6):
            work[column, row] = sums[k, place]
            place += 1
    for row in range(6):
        size = work[row, row]
        work[6, row] = 1.0 / math.sqrt(size if size > _LEAST else _LEAST) if size > 0.0 else 0.0
    for row in range(6):
        steps[i, row] = work[6, row] * sums[k, 21 + row]
        for column in range(row + 1):
            rest = work[row, column] * work[6, row] * work[6, column]
            rest = 1.0 + damping if row == column else rest
            for m in range(column):
                rest -= work[row, m] * work[column, m]
            if row == column:
                work[row, row] = math.sqrt(rest if rest > _LEAST else _LEAST)
            else:
                work[row, column] = rest / work[column, column]
                steps[i, row] -= work[row, column] * steps[i, column]
        steps[i, row] /= work[row, row]
    for row in range(5, -1, -1):
        for m in range(row + 1, 6):
            steps[i, row] -= work[m, row] * steps[i, m]
        steps[i, row] /= work[row, row]
    for row in range(6):
        steps[i, row] *= -work[6, row]


@compiled()
def descend(sums, T, dampings, active, steps, tried, new, limits):  # type: ignore[no-untyped-def]
    """A step of Levenberg-Marquardt of many poses, each by itself.

    Poses that were tried are taken where the cost does not rise; of those that are not done, the
    next are tried. The first rows of ``active``, ``steps`` and ``tried`` are theirs.

    Args:
        sums: (f, 28) at the poses, replaced where these move.
        T: (f, 4, 4) T_camera_lidar, likewise.
        dampings: (f,) likewise.
        active: (f,) numbers of the poses that move.
        steps: (f, 6) to those that were tried.
        tried: (f, 4, 4) T_camera_lidar.
        new: (a, 28) sums of those that were tried; empty at first.
        limits: relative decrease of the cost at which a pose is done; most that a step turns about
            an axis [rad].

    Returns:
        How many are tried next.
    """
    work, left = np.empty((7, 6)), np.int64(0)
    for i in range(len(new) or len(active)):
        k = active[i]
        if len(new):
            gain, size = sums[k, 27] - new[i, 27], 0.0
            is_done = gain >= 0.0 and gain <= limits[0] * sums[k, 27]
            for m in range(6):
                size = abs(steps[i, m]) if abs(steps[i, m]) > size else size
            if gain >= 0.0:
                for m in range(28):
                    sums[k, m] = new[i, m]
                for m in range(4):
                    for n in range(4):
                        T[k, m, n] = tried[i, m, n]
            damping = dampings[k] * (0.1 if gain >= 0.0 else 10.0)
            dampings[k] = damping if damping > _MIN_DAMPING else _MIN_DAMPING
            if is_done or size < _SMALL_STEP or not dampings[k] < MAX_DAMPING:
                continue
        active[left] = k
        _solve_damped(sums, k, dampings[k], work, steps, left)
        turn = 0.0
        for m in range(3):
            turn = abs(steps[left, m]) if abs(steps[left, m]) > turn else turn
        if turn > limits[1]:
            for m in range(6):
                steps[left, m] *= limits[1] / turn
        _move(-1.0, steps, left, T, k, tried)
        left += 1
    return left
