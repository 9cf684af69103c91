"""Exponential and logarithm of SE(3) for many poses at once.

As GTSAM's, of twists (rotation [rad], translation [m]). Below a small angle, series of two terms
are as exact as the closed formulas.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-2  # rad
_CROSS = np.zeros((3, 3, 3))  # the matrices of the cross products with the axes
_CROSS[0, 2, 1] = _CROSS[1, 0, 2] = _CROSS[2, 1, 0] = 1.0
_CROSS[0, 1, 2] = _CROSS[1, 2, 0] = _CROSS[2, 0, 1] = -1.0


def exponential_times(twists: Array, T: Array, out: Array) -> None:
    """Fill (f, 4, 4) ``out`` with exp(twist) T of (f, 6) twists and (f, 4, 4) transforms."""
    squared = np.einsum("fi,fi->f", twists[:, :3], twists[:, :3])
    angle, small = np.sqrt(squared), squared < _SMALL_ANGLE**2
    safe = np.where(small, 1.0, angle)
    by_sine = np.where(small, 1 - squared / 6 * (1 - squared / 20), np.sin(safe) / safe)
    by_cosine = np.where(
        small, 0.5 - squared / 24 * (1 - squared / 30), 2 * (np.sin(safe / 2) / safe) ** 2
    )
    rest = np.where(small, 1 / 6 - squared / 120, (1 - by_sine) / safe**2)
    # R = I + by_sine [w]x + by_cosine [w]x^2,  t = (I + by_cosine [w]x + rest [w]x^2) v.
    cross = np.tensordot(twists[:, :3], _CROSS, 1)
    twice = cross @ cross
    step = np.zeros((len(twists), 4, 4))
    step[:, :3, :3] = _series(cross, twice, by_sine, by_cosine)
    step[:, :3, 3:] = _series(cross, twice, by_cosine, rest) @ twists[:, 3:, None]
    step[:, 3, 3] = 1.0
    np.matmul(step, T, out=out)


def logarithms(steps: Array) -> Array:
    """(f, 6) twists of (f, 4, 4) transforms."""
    if not len(steps):
        return np.empty((0, 6))
    turn = Rotation.from_matrix(steps[:, :3, :3]).as_rotvec()
    squared = np.einsum("fi,fi->f", turn, turn)
    small = squared < _SMALL_ANGLE**2
    safe = np.where(small, 1.0, np.sqrt(squared))
    inward = np.where(small, 1 / 12 + squared / 720, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    # The inverse of the left Jacobian: I - [w]x / 2 + inward [w]x^2.
    cross = np.tensordot(turn, _CROSS, 1)
    back = _series(cross, cross @ cross, np.full(len(turn), -0.5), inward)
    return np.hstack([turn, (back @ steps[:, :3, 3:])[:, :, 0]])


def between_errors(one: Array, two: Array) -> tuple[Array, Array, Array]:
    """(n, 6) log(one^-1 two) of (n, 4, 4) transforms; (n, 6, 6) its derivatives by both tangents.

    That of the second is the inverse of the right Jacobian, by the series of Bernoulli numbers up
    to the fourth power: displacements are far below a radian. That of the first is minus it, times
    Ad(two^-1 one).
    """
    relative = np.array(two)
    relative[:, :3, :3] = one[:, :3, :3].transpose(0, 2, 1) @ two[:, :3, :3]
    apart = two[:, :3, 3:] - one[:, :3, 3:]
    relative[:, :3, 3:] = one[:, :3, :3].transpose(0, 2, 1) @ apart
    errors = logarithms(relative)
    ad = np.zeros((len(one), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = np.tensordot(errors[:, :3], _CROSS, 1)
    ad[:, 3:, :3] = np.tensordot(errors[:, 3:], _CROSS, 1)
    squared = ad @ ad
    by_two = np.eye(6) + ad / 2 + squared / 12 - squared @ squared / 720
    return errors, -by_two @ _inverse_adjoints(relative), by_two


def _series(cross: Array, twice: Array, first: Array, second: Array) -> Array:
    """(f, 3, 3) I + first [w]x + second [w]x^2."""
    return np.eye(3) + first[:, None, None] * cross + second[:, None, None] * twice


def _inverse_adjoints(T: Array) -> Array:
    """(f, 6, 6) Ad(T^-1) = [R^T, 0; -R^T [t]x, R^T]."""
    out, back = np.zeros((len(T), 6, 6)), T[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, :3] = out[:, 3:, 3:] = back
    out[:, 3:, :3] = -back @ np.tensordot(T[:, :3, 3], _CROSS, 1)
    return out
