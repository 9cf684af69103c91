"""Exponential and logarithm of SE(3) for many poses at once, compiled.

As GTSAM's, of twists (rotation [rad], translation [m]). Below a small angle, series of two terms
are as exact as the closed formulas.
"""

import math

import numpy as np

from factors.compiled import compiled

_SMALL_ANGLE = 1e-2  # rad


@compiled()
def exponential_times(twists, T, out):  # type: ignore[no-untyped-def]
    """Fill (f, 4, 4) ``out`` with exp(twist) T of (f, 6) twists and (f, 4, 4) transforms."""
    for i in range(len(twists)):
        x, y, z = twists[i, 0], twists[i, 1], twists[i, 2]
        u, v, w = twists[i, 3], twists[i, 4], twists[i, 5]
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
            t0, t1, t2 = T[i, 0, column], T[i, 1, column], T[i, 2, column]
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
