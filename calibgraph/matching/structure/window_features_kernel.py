"""The kernel that describes how range and intensity vary over windows, for their weights."""

import math

import numpy as np

from factors.compiled import compiled

FEATURES = (
    "depth varies", "intensity varies", "share of rays", "log range", "log spread of log range",
    "share behind", "log width", "log height", "depth beside a plane", "depth in two classes",
    "log spread of intensity", "intensity beside a trend", "intensity in two classes",
    "centre behind the median",
)  # fmt: skip


@compiled()
def fill_features(cloud, members, counts, front, basis, out):  # type: ignore[no-untyped-def]
    """Fill the features (w, f) of windows, see ``FEATURES``.

    cloud: rays (n, 3) [m] and intensity ranks (n,); members: (w, l); counts: (w,); front: (w, l);
    basis: (w, l, 4).
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    inverse, shade, logs = np.empty(size), np.empty(size), np.empty(size)
    u, v, ordered = np.empty(size), np.empty(size), np.empty(size)
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
        out[w, 9] = _in_two_classes(inverse, n, ordered)
        median = 1.0 / ordered[n // 2]
        out[w, 3], out[w, 13] = math.log(median), 1.0 - median * math.exp(-centre)
        out[w, 12] = _in_two_classes(shade, n, ordered)
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
    return 1.0 - min(followed / max(power, 1e-12), 1.0)


@compiled(part=True)
def _in_two_classes(values, n, ordered):  # type: ignore[no-untyped-def]
    """The largest share of the variation that lies between two classes (Otsu); sorts the values."""
    total, squares = 0.0, 0.0
    for i in range(n):
        k = i
        while k > 0 and ordered[k - 1] > values[i]:
            ordered[k] = ordered[k - 1]
            k -= 1
        ordered[k] = values[i]
        total, squares = total + values[i], squares + values[i] * values[i]
    variation = squares - total * total / n
    below, between = 0.0, 0.0
    for i in range(n - 1):
        below += ordered[i]
        apart = below - total * (i + 1) / n
        between = max(between, apart * apart * n / ((i + 1) * (n - i - 1)))
    return between / variation if variation > 1e-12 else 0.0  # noqa: PLR2004
