"""The rotation with the least sum of angles to given ones: Weiszfeld's algorithm on SO(3)."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from factors.compiled import compiled

_MEDOID_OF = 500  # rotations at most: it is a start of the median, and its cost is quadratic
_STEPS, _CONVERGED_RAD = 100, 1e-12  # far below any rotation that matters


def geodesic_median(rotations: Rotation) -> Rotation:
    """Rotation with the least sum of angles to the given ones."""
    quaternions = np.array(rotations.as_quat())
    median = quaternions[_medoid(quaternions)].copy()
    _descend(quaternions, median)
    return Rotation.from_quat(median)


def _medoid(quaternions: Array) -> int:
    """Index of the rotation with the least sum of angles to the others; of many, to a selection."""
    places = np.arange(len(quaternions))
    if len(places) > _MEDOID_OF:
        places = np.linspace(0, len(quaternions) - 1, _MEDOID_OF).round().astype(int)
    selection = quaternions[places]
    cosines = np.abs(selection @ selection.T).clip(max=1.0)
    return int(places[np.argmin(np.arccos(cosines).sum(axis=0))])


@compiled()
def _descend(quaternions, median):  # type: ignore[no-untyped-def]
    """Move a median (4,) of quaternions (n, 4), x y z w, until it stays where it is."""
    for _ in range(_STEPS):
        x, y, z, w = median[0], median[1], median[2], median[3]
        total = a = b = c = 0.0
        for i in range(len(quaternions)):
            p, q, r, s = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
            # The vector of q * median^-1, and its scalar part.
            u, v = p * w - q * z + r * y - s * x, p * z + q * w - r * x - s * y
            t, cosine = -p * y + q * x + r * w - s * z, p * x + q * y + r * z + s * w
            sine = math.sqrt(u * u + v * v + t * t)
            angle = 2.0 * math.atan2(sine, abs(cosine))
            weight = 1.0 / max(angle, _CONVERGED_RAD)
            share = math.copysign(weight * (angle / sine if sine > 0.0 else 2.0), cosine)
            total += weight
            a, b, c = a + share * u, b + share * v, c + share * t
        a, b, c = a / total, b / total, c / total
        length = math.sqrt(a * a + b * b + c * c)
        half = math.sin(length / 2.0) / length if length > 0.0 else 0.5
        a, b, c, s = half * a, half * b, half * c, math.cos(length / 2.0)
        median[0], median[1] = a * w + b * z - c * y + s * x, -a * z + b * w + c * x + s * y
        median[2], median[3] = a * y - b * x + c * w + s * z, -a * x - b * y - c * z + s * w
        if length < _CONVERGED_RAD:
            break
