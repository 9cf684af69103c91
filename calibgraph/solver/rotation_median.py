"""The geodesic median of rotations, compiled: its iteration takes up to a hundred small steps."""

import math

import numpy as np

from factors.compiled import compiled

_ITERATIONS = 100
_CONVERGED = 1e-12  # rad: far below any rotation that matters


@compiled()
def median_rotation(quaternions, start):  # type: ignore[no-untyped-def]
    """Quaternion of the least sum of angles to (n, 4) unit quaternions x y z w, from a start.

    Weiszfeld's iteration in the tangent at the median so far.
    """
    mx, my, mz, mw = start
    for _ in range(_ITERATIONS):
        step, total = np.zeros(3), 0.0
        for i in range(len(quaternions)):
            x, y, z, w = quaternions[i]
            # q * conj(m)
            u = w * -mx + x * mw + y * -mz - z * -my
            v = w * -my - x * -mz + y * mw + z * -mx
            t = w * -mz + x * -my - y * -mx + z * mw
            c = w * mw + x * mx + y * my + z * mz
            s = math.sqrt(u * u + v * v + t * t)
            angle = 2.0 * math.atan2(s, abs(c))
            weight = 1.0 / max(angle, _CONVERGED)
            factor = weight * (angle / s if s > 0.0 else 2.0) * (1.0 if c >= 0.0 else -1.0)
            step[0] += factor * u
            step[1] += factor * v
            step[2] += factor * t
            total += weight
        step /= total
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        scale = math.sin(length / 2) / length if length > 0.0 else 0.5
        x, y, z, w = scale * step[0], scale * step[1], scale * step[2], math.cos(length / 2)
        # exp(step) * m
        mx, my, mz, mw = (
            w * mx + x * mw + y * mz - z * my,
            w * my - x * mz + y * mw + z * mx,
            w * mz + x * my - y * mx + z * mw,
            w * mw - x * mx - y * my - z * mz,
        )
        if length < _CONVERGED:
            break
    return np.array([mx, my, mz, mw])
