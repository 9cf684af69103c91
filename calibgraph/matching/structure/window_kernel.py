"""The kernel that describes windows: what varies over their rays, and where silhouettes are."""

from __future__ import annotations

import math

import numpy as np

from factors.compiled import compiled

INTENSITY_NOISE = 0.05  # of intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # of relative inverse range: below, a window counts as flat
SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
SCAN_LINE = 1e-3  # ratio of variances below which a window's rays lie on one line


@compiled(nogil=True, error_model="numpy")
def describe_windows(cloud, members, counts, keep_linear, moved_m, front, basis, reliability):  # type: ignore[no-untyped-def]
    """Fill the rays, the silhouettes and the bases of windows, see :class:`windows.Windows`.

    cloud: rays (n, 3) [m] and intensity ranks (n,); members: (w, l); counts: (w,). Filled are
    moved_m (w, l, 3), front (w, l), basis (w, l, 4), and reliability (w,): the larger of those of
    inverse range and intensity.
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    ranges, inverse, intensity = np.empty(size), np.empty(size), np.empty(size)
    trend = np.zeros((2, size))
    directions = np.empty((size, 3))
    for w in range(len(members)):
        n = counts[w]
        for i in range(size):
            row = members[w, i]
            x, y, z = rays_m[row, 0], rays_m[row, 1], rays_m[row, 2]
            ranges[i] = math.sqrt(x * x + y * y + z * z)
            inverse[i], intensity[i] = 1.0 / ranges[i], intensity_rank[row]
            directions[i, 0], directions[i, 1] = x * inverse[i], y * inverse[i]
            directions[i, 2] = z * inverse[i]
        near = _find_silhouette(inverse[:n])
        for i in range(size):
            front[w, i] = inverse[i] >= near
            moved = ranges[i] if front[w, i] else 1.0 / near
            for axis in range(3):
                moved_m[w, i, axis] = directions[i, axis] * moved
        if not keep_linear:
            _fill_trend(directions[:n], trend)
        inverse[:n] /= inverse[:n].mean()
        depth_weight = _normalize(inverse[:n], trend[:, :n], inverse[:0], DEPTH_NOISE)
        weight = _normalize(intensity[:n], trend[:, :n], inverse[:n], INTENSITY_NOISE)
        for i in range(n):
            basis[w, i, 0], basis[w, i, 1] = inverse[i] * depth_weight, intensity[i] * weight
            basis[w, i, 2], basis[w, i, 3] = trend[0, i], trend[1, i]
        basis[w, n:] = 0.0
        reliability[w] = max(depth_weight, weight)


@compiled(nogil=True, error_model="numpy")
def _find_silhouette(inverse):  # type: ignore[no-untyped-def]
    """The inverse range of the near side of a window's silhouette; 0 if it has none.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps.
    """
    ordered = np.sort(inverse)
    widest = 0
    for i in range(len(ordered) - 1):
        if ordered[i + 1] - ordered[i] >= ordered[widest + 1] - ordered[widest]:
            widest = i
    far, near = ordered[widest], ordered[min(widest + 1, len(ordered) - 1)]
    wide = near - far > SILHOUETTE_SHARE * (ordered[-1] - ordered[0])
    return near if wide and near > SILHOUETTE_RATIO * far else 0.0


@compiled(nogil=True, error_model="numpy")
def _fill_trend(directions, trend):  # type: ignore[no-untyped-def]
    """Fill an orthonormal basis of the linear functions of direction in a window.

    Inverse range is linear in direction on any plane, and shading mostly so: without these parts
    only edges and markings are left to match. A single scan line has one such function only.
    """
    n = len(directions)
    x, y, z = directions[0, 0], directions[0, 1], directions[0, 2]
    flat = math.sqrt(x * x + y * y)
    along_x, along_y = (-y / flat, x / flat) if flat > 1e-9 else (1.0, 0.0)  # noqa: PLR2004
    up_x, up_y, up_z = -z * along_y, z * along_x, x * along_y - y * along_x
    u, v = np.empty(n), np.empty(n)
    for i in range(n):
        a, b, c = directions[i, 0], directions[i, 1], directions[i, 2]
        u[i] = a * along_x + b * along_y
        v[i] = a * up_x + b * up_y + c * up_z
    u -= u.mean()
    v -= v.mean()
    uu, uv, vv = (u * u).sum(), (u * v).sum(), (v * v).sum()
    angle = 0.5 * math.atan2(2 * uv, uu - vv)  # of the longer axis
    cos, sin = math.cos(angle), math.sin(angle)
    major = cos * cos * uu + 2 * cos * sin * uv + sin * sin * vv
    minor = sin * sin * uu - 2 * cos * sin * uv + cos * cos * vv
    of_minor = 1.0 / math.sqrt(minor) if minor > SCAN_LINE * major else 0.0
    of_major = 1.0 / math.sqrt(major) if major > 0 else 0.0
    for i in range(n):
        trend[0, i] = (cos * v[i] - sin * u[i]) * of_minor
        trend[1, i] = (cos * u[i] + sin * v[i]) * of_major


@compiled(nogil=True, error_model="numpy")
def _normalize(values, trend, other, noise):  # type: ignore[no-untyped-def]
    """Centre and normalise values in place, orthogonal to the trend and to another column.

    Inverse range comes first: the part that it shares with the intensity has no reliable sign.

    Returns:
        The reliability: 0 where the values are flat, 1 where they vary much.
    """
    n = len(values)
    values -= values.mean()
    first, second = (values * trend[0]).sum(), (values * trend[1]).sum()
    values -= first * trend[0] + second * trend[1]
    if len(other):
        values -= (values * other).sum() * other
    power = (values * values).sum()
    values /= math.sqrt(power + 1e-12)
    return math.sqrt(power / (power + n * noise * noise))
