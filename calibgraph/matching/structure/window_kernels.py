"""The kernels that describe windows: the variation over their rays, silhouettes, and features.

The features, how range and intensity vary over a window, are what its weight depends on.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

INTENSITY_NOISE = 0.05  # of intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # of relative inverse range: below, a window counts as flat
SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
SCAN_LINE = 1e-3  # ratio of variances below which a window's rays lie on one line
FEATURES = (
    "depth varies", "intensity varies", "share of rays", "log range", "log spread of log range",
    "share behind", "log width", "log height", "depth beside a plane", "depth in two classes",
    "log spread of intensity", "intensity beside a trend", "intensity in two classes",
    "centre behind the median",
)  # fmt: skip


def make_room(size: int) -> tuple[NDArray[Any], ...]:
    """Work space of the kernels: eight columns of floats, one of integers, ``size`` rays long."""
    return *np.empty((8, size)), np.empty(size, np.int64)


@compiled()
def describe_windows(  # type: ignore[no-untyped-def]
    cloud, members, counts, keep_linear, room, moved_m, front, basis, reliability
):
    """Fill the rays, the silhouettes and the bases of windows, see :class:`windows.Windows`.

    cloud: rays (n, 3) [m] and intensity ranks (n,); members: (w, l); counts: (w,); room: see
    :func:`make_room`. Filled are moved_m (w, l, 3), front (w, l), basis (w, l, 4), and reliability
    (w,), the larger one of inverse range and intensity. Array expressions, np.empty, max and min
    compile slowly, so there are loops and conditions instead.
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    inverse, intensity, ordered, trend_u, trend_v, xs, ys, zs, places = room
    for i in range(size):
        trend_u[i] = trend_v[i] = 0.0
    for w in range(len(members)):
        n = counts[w]
        for i in range(size):
            row = members[w, i]
            x, y, z = rays_m[row, 0], rays_m[row, 1], rays_m[row, 2]
            inverse[i] = 1.0 / math.sqrt(x * x + y * y + z * z)
            intensity[i] = intensity_rank[row]
            xs[i], ys[i], zs[i] = x * inverse[i], y * inverse[i], z * inverse[i]
        near = _find_silhouette(inverse, n, ordered, places)
        for i in range(size):
            front[w, i] = inverse[i] >= near
            moved = 1.0 / (near if near > inverse[i] else inverse[i])
            moved_m[w, i, 0], moved_m[w, i, 1] = xs[i] * moved, ys[i] * moved
            moved_m[w, i, 2] = zs[i] * moved
        if not keep_linear:
            _fill_trend(xs, ys, zs, n, trend_u, trend_v)
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
        reliability[w] = shade if shade > depth else depth


@compiled(part=True)
def _sort(values, n, ordered, places):  # type: ignore[no-untyped-def]
    """Fill ``ordered`` with the first n values, the least one first.

    By counting the lesser ones, without branches: half the time of an insertion.
    """
    for i in range(n):
        places[i] = 0
    for k in range(n):
        for i in range(n):
            places[i] += (values[k] < values[i]) | ((values[k] == values[i]) & (k < i))
    for i in range(n):
        ordered[places[i]] = values[i]


@compiled(part=True)
def _find_silhouette(inverse, n, ordered, places):  # type: ignore[no-untyped-def]
    """The inverse range of the near side of a window's silhouette; 0 if it has none.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps. ordered, places: room for as many values.
    """
    _sort(inverse, n, ordered, places)
    near, far = 0.0, 0.0
    for i in range(n - 1):
        if ordered[i + 1] - ordered[i] >= near - far:
            near, far = ordered[i + 1], ordered[i]
    wide = near - far > SILHOUETTE_SHARE * (ordered[n - 1] - ordered[0])
    return near if wide and near > SILHOUETTE_RATIO * far else 0.0


@compiled(part=True)
def _fill_trend(xs, ys, zs, n, trend_u, trend_v):  # type: ignore[no-untyped-def]
    """Fill an orthonormal basis of the linear functions of direction in a window.

    Inverse range is linear in direction on any plane, and shading mostly so: without these parts
    only edges and markings are left to match. A single scan line has one such function only.
    """
    x, y, z = xs[0], ys[0], zs[0]
    flat = math.sqrt(x * x + y * y)
    along_x, along_y = (-y / flat, x / flat) if flat > 1e-9 else (1.0, 0.0)  # noqa: PLR2004
    up_x, up_y, up_z = -z * along_y, z * along_x, x * along_y - y * along_x
    mean_u, mean_v = 0.0, 0.0
    for i in range(n):
        a, b, c = xs[i], ys[i], zs[i]
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


@compiled()
def fill_features(cloud, members, counts, room, front, basis, out):  # type: ignore[no-untyped-def]
    """Fill the features (w, f) of windows, see ``FEATURES``.

    ``cloud`` to ``basis`` as of :func:`describe_windows`.
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    inverse, shade, logs, u, v, ordered, _, _, places = room
    for w in range(len(members)):
        n = counts[w]
        x0, y0, z0 = rays_m[members[w, 0], 0], rays_m[members[w, 0], 1], rays_m[members[w, 0], 2]
        flat, whole = math.sqrt(x0 * x0 + y0 * y0), math.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        ax, ay = (-y0 / flat, x0 / flat) if flat > 0 else (1.0, 0.0)
        sine, cosine = z0 / whole, flat / whole
        ux, uy, uz = -sine * ay, sine * ax, cosine  # up, across the ray
        depth, intensity, behind = 0.0, 0.0, 0.0
        for i in range(n):
            row = members[w, i]
            x, y, z = rays_m[row, 0], rays_m[row, 1], rays_m[row, 2]
            inverse[i] = 1.0 / math.sqrt(x * x + y * y + z * z)
            logs[i], shade[i] = -math.log(inverse[i]), intensity_rank[row]
            u[i] = (x * ax + y * ay) * inverse[i]
            v[i] = (x * ux + y * uy + z * uz) * inverse[i]
            depth += basis[w, i, 0] ** 2
            intensity += basis[w, i, 1] ** 2
            behind += 0.0 if front[w, i] else 1.0
        centre = logs[0]
        out[w, 0], out[w, 1], out[w, 2], out[w, 5] = depth, intensity, n / size, behind / n
        out[w, 9] = _in_two_classes(inverse, n, ordered, places)
        median = 1.0 / ordered[n // 2]
        out[w, 3], out[w, 13] = math.log(median), 1.0 - median * math.exp(-centre)
        out[w, 12] = _in_two_classes(shade, n, ordered, places)
        out[w, 4] = math.log(1e-3 + _centre(logs, n))
        out[w, 6], out[w, 7] = math.log(1e-5 + _centre(u, n)), math.log(1e-5 + _centre(v, n))
        _centre(inverse, n)
        out[w, 10] = math.log(1e-3 + _centre(shade, n))
        out[w, 8], out[w, 11] = _beside_trend(inverse, u, v, n), _beside_trend(shade, u, v, n)


@compiled(part=True)
def _centre(values, n):  # type: ignore[no-untyped-def]
    """Subtract the mean of the first n; their standard deviation."""
    mean, power = 0.0, 0.0
    for i in range(n):
        mean += values[i] / n
    for i in range(n):
        values[i] -= mean
        power += values[i] * values[i]
    return math.sqrt(power / n)


@compiled(part=True)
def _beside_trend(values, u, v, n):  # type: ignore[no-untyped-def]
    """The share of the variation of centred values that no linear function of u and v follows."""
    uu, uv, vv, along_u, along_v, power = 1e-12, 0.0, 1e-12, 0.0, 0.0, 0.0
    for i in range(n):
        uu, uv, vv = uu + u[i] * u[i], uv + u[i] * v[i], vv + v[i] * v[i]
        along_u, along_v = along_u + u[i] * values[i], along_v + v[i] * values[i]
        power += values[i] * values[i]
    det = uu * vv - uv * uv
    followed = (vv * along_u**2 - 2 * uv * along_u * along_v + uu * along_v**2) / det
    share = followed / (power if power > 1e-12 else 1e-12)  # noqa: PLR2004
    return 1.0 - (share if share < 1.0 else 1.0)


@compiled(part=True)
def _in_two_classes(values, n, ordered, places):  # type: ignore[no-untyped-def]
    """The largest share of the variation that lies between two classes (Otsu); sorts the values."""
    total, squares = 0.0, 0.0
    _sort(values, n, ordered, places)
    for i in range(n):
        total, squares = total + values[i], squares + values[i] * values[i]
    variation = squares - total * total / n
    below, between = 0.0, 0.0
    for i in range(n - 1):
        below += ordered[i]
        apart = below - total * (i + 1) / n
        squared = apart * apart * n / ((i + 1) * (n - i - 1))
        between = squared if squared > between else between
    return between / variation if variation > 1e-12 else 0.0  # noqa: PLR2004
