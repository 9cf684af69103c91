"""The kernel that describes windows: the variation over their rays, and their silhouettes."""

import math

import numpy as np

from factors.compiled import compiled

INTENSITY_NOISE = 0.05  # of intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # of relative inverse range: below, a window counts as flat
SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
SCAN_LINE = 1e-3  # ratio of variances below which a window's rays lie on one line


@compiled()
def describe_windows(cloud, members, counts, keep_linear, moved_m, front, basis, reliability):  # type: ignore[no-untyped-def]
    """Fill the rays, the silhouettes and the bases of windows, see :class:`windows.Windows`.

    cloud: rays (n, 3) [m] and intensity ranks (n,); members: (w, l); counts: (w,). Filled are
    moved_m (w, l, 3), front (w, l), basis (w, l, 4), and reliability (w,): the larger of those of
    inverse range and intensity. Loops in place of array expressions: these compile slowly.
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    inverse, intensity, ordered = np.empty(size), np.empty(size), np.empty(size)
    trend_u, trend_v, directions = np.empty(size), np.empty(size), np.empty((size, 3))
    for i in range(size):
        trend_u[i] = trend_v[i] = 0.0
    for w in range(len(members)):
        n = counts[w]
        for i in range(size):
            row = members[w, i]
            x, y, z = rays_m[row, 0], rays_m[row, 1], rays_m[row, 2]
            inverse[i] = 1.0 / math.sqrt(x * x + y * y + z * z)
            intensity[i] = intensity_rank[row]
            directions[i, 0], directions[i, 1] = x * inverse[i], y * inverse[i]
            directions[i, 2] = z * inverse[i]
        near = _find_silhouette(inverse, n, ordered)
        for i in range(size):
            front[w, i] = inverse[i] >= near
            moved = 1.0 / max(inverse[i], near)
            for axis in range(3):
                moved_m[w, i, axis] = directions[i, axis] * moved
        if not keep_linear:
            _fill_trend(directions, n, trend_u, trend_v)
        mean = 0.0
        for i in range(n):
            mean += inverse[i] / n
        for i in range(n):
            inverse[i] /= mean
        depth = _normalize(inverse, n, trend_u, trend_v, inverse, 0.0, DEPTH_NOISE)
        shade = _normalize(intensity, n, trend_u, trend_v, inverse, 1.0, INTENSITY_NOISE)
        for i in range(size):
            used = 1.0 if i < n else 0.0
            basis[w, i, 0] = used * depth * inverse[i]
            basis[w, i, 1] = used * shade * intensity[i]
            basis[w, i, 2], basis[w, i, 3] = used * trend_u[i], used * trend_v[i]
        reliability[w] = max(depth, shade)


@compiled(part=True)
def _find_silhouette(inverse, n, ordered):  # type: ignore[no-untyped-def]
    """The inverse range of the near side of a window's silhouette; 0 if it has none.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps. ordered: room for as many values.
    """
    for i in range(n):
        k = i
        while k > 0 and ordered[k - 1] > inverse[i]:
            ordered[k] = ordered[k - 1]
            k -= 1
        ordered[k] = inverse[i]
    near, far = 0.0, 0.0
    for i in range(n - 1):
        if ordered[i + 1] - ordered[i] >= near - far:
            near, far = ordered[i + 1], ordered[i]
    wide = near - far > SILHOUETTE_SHARE * (ordered[n - 1] - ordered[0])
    return near if wide and near > SILHOUETTE_RATIO * far else 0.0


@compiled(part=True)
def _fill_trend(directions, n, trend_u, trend_v):  # type: ignore[no-untyped-def]
    """Fill an orthonormal basis of the linear functions of direction in a window.

    Inverse range is linear in direction on any plane, and shading mostly so: without these parts
    only edges and markings are left to match. A single scan line has one such function only.
    """
    x, y, z = directions[0, 0], directions[0, 1], directions[0, 2]
    flat = math.sqrt(x * x + y * y)
    along_x, along_y = (-y / flat, x / flat) if flat > 1e-9 else (1.0, 0.0)  # noqa: PLR2004
    up_x, up_y, up_z = -z * along_y, z * along_x, x * along_y - y * along_x
    mean_u, mean_v = 0.0, 0.0
    for i in range(n):
        a, b, c = directions[i, 0], directions[i, 1], directions[i, 2]
        trend_u[i] = a * along_x + b * along_y
        trend_v[i] = a * up_x + b * up_y + c * up_z
        mean_u += trend_u[i] / n
        mean_v += trend_v[i] / n
    uu, uv, vv = 0.0, 0.0, 0.0
    for i in range(n):
        u, v = trend_u[i] - mean_u, trend_v[i] - mean_v
        uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    angle = 0.5 * math.atan2(2 * uv, uu - vv)  # of the longer axis
    cos, sin = math.cos(angle), math.sin(angle)
    major = cos * cos * uu + 2 * cos * sin * uv + sin * sin * vv
    minor = sin * sin * uu - 2 * cos * sin * uv + cos * cos * vv
    of_minor = 1.0 / math.sqrt(minor) if minor > SCAN_LINE * major else 0.0
    of_major = 1.0 / math.sqrt(major) if major > 0 else 0.0
    for i in range(n):
        u, v = trend_u[i] - mean_u, trend_v[i] - mean_v
        trend_u[i], trend_v[i] = (cos * v - sin * u) * of_minor, (cos * u + sin * v) * of_major


@compiled(part=True)
def _normalize(values, n, trend_u, trend_v, other, by_other, noise):  # type: ignore[no-untyped-def]
    """Centre and normalise values in place, orthogonal to the trend and to another column.

    Inverse range comes first: the part that it shares with the intensity has no reliable sign.

    Returns:
        The reliability: 0 where the values are flat, 1 where they vary much.
    """
    mean = 0.0
    for i in range(n):
        mean += values[i] / n
    along_u, along_v, along = 0.0, 0.0, 0.0
    for i in range(n):
        values[i] -= mean
        along_u += values[i] * trend_u[i]
        along_v += values[i] * trend_v[i]
    for i in range(n):
        values[i] -= along_u * trend_u[i] + along_v * trend_v[i]
        along += by_other * values[i] * other[i]
    power = 0.0
    for i in range(n):
        values[i] -= by_other * along * other[i]
        power += values[i] * values[i]
    for i in range(n):
        values[i] /= math.sqrt(power + 1e-12)
    return math.sqrt(power / (power + n * noise * noise))
