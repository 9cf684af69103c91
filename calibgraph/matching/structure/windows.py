"""LiDAR windows: neighbourhoods of rays, with the variation to look for in the image.

A window is a LiDAR point with its nearest rays. Its basis holds how inverse range and intensity
vary over these rays: :mod:`calibgraph.matching.structure.shift_scores` correlates the image with
it. Windows belong to a cloud and a viewpoint: they are cut once, see
:mod:`calibgraph.matching.structure.window_table`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.window_weights import FEATURES, WindowNetwork

WINDOW_POINTS = 25  # samples of a window; fewer cannot hold an edge and both its sides
MIN_WINDOW_POINTS = 9
WINDOW_STRETCH = 4.0  # longest window by the radius of an even one: room for single scan lines
MIN_WEIGHT = 0.1  # of a window that counts where windows are weighed
MIN_SPACING_RAD = np.radians(0.15)  # few sensors sample more finely along their scan lines
MIN_RELIABILITY = 0.3  # of a window's variation: 0 where it is flat, 1 where much varies
INTENSITY_NOISE = 0.05  # of intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # of relative inverse range: below, a window counts as flat
SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
SCAN_LINE = 1e-3  # ratio of variances below which a window's rays lie on one line
_TINY = 1e-12

WINDOW = np.dtype([
    ("rays_m", "f4", (WINDOW_POINTS, 3)), ("members", "i4", WINDOW_POINTS),
    ("front", "?", WINDOW_POINTS), ("count", "i4"), ("basis", "f4", (WINDOW_POINTS, 4)),
    ("features", "f4", len(FEATURES)), ("weight", "f4"),
], align=True)  # fmt: skip
"""A correlation window of a cloud.

``rays_m``: from the viewpoint, along the axes of the LiDAR frame, to the points, the window's
centre first. Points behind a silhouette are moved along their rays to its distance, which
determines where the silhouette is in the image. ``members``: the same points, as rows of their
table's rays. ``front``: which of them are not behind a silhouette. ``count``: how many of the
members are in use: the first ones. ``basis``: columns: inverse range and intensity (orthonormal,
shrunk where they are flat), and the two linear functions of direction; these are zero where a
window keeps its linear parts. ``features``: what its weight depends on; zeros where a window does
not keep its linear parts. ``weight``: how much a window tells where it is, 0 to 1; 1 until it is
weighed.
"""
Windows = NDArray[np.void]
"""(w,) of WINDOW."""


def weigh(windows: Windows, network: WindowNetwork) -> Windows:
    """Those that tell something, with the shares of variation they explain times the weights.

    What is left out, a fifth of all, changes no z-score by more than a fiftieth.
    """
    weight = network.weights(windows["features"])
    kept = windows[weight > MIN_WEIGHT]
    kept["weight"] = weight[weight > MIN_WEIGHT]
    kept["basis"] *= np.sqrt(kept["weight"])[:, None, None]
    return kept


def cut_windows(
    cloud: tuple[Array, Array],
    centres: NDArray[np.int32],
    thinned: tuple[cKDTree, NDArray[np.int32]],
    *,
    spacing_rad: float,
    keep_linear: bool,
) -> tuple[Windows, Mask]:
    """Cut windows of the nearest rays.

    Args:
        cloud: (n, 3) rays from the viewpoint to the points, along the axes of the LiDAR frame
            [m]; (n,) their intensity ranks.
        centres: (w,) of the thinned rays, those that are the windows' centres.
        thinned: the directions of (m,) rays, as unit vectors, and their rows of the cloud.
        spacing_rad: of these.
        keep_linear: keep the linear parts of the variation, and describe it.

    Returns:
        The windows that are large enough and not flat; (w,) which they are.
    """
    even = math.sqrt(WINDOW_POINTS / math.pi) * max(spacing_rad, MIN_SPACING_RAD)
    reach = 2 * math.sin(WINDOW_STRETCH * even / 2)  # as a chord
    tree, rows = thinned
    _, nearest = tree.query(tree.data[centres], WINDOW_POINTS, distance_upper_bound=reach)
    useful = (nearest < tree.n).sum(axis=1) >= MIN_WINDOW_POINTS  # the others are out of reach
    nearest, centres = nearest[useful], centres[useful]
    used = nearest < tree.n
    members = rows[np.where(used, nearest, centres[:, None])]
    windows, reliability = describe_windows(cloud, members, used, keep_linear=keep_linear)
    useful[useful] = reliability > MIN_RELIABILITY
    return windows[reliability > MIN_RELIABILITY], useful


def describe_windows(
    cloud: tuple[Array, Array], members: NDArray[np.int32], used: Mask, *, keep_linear: bool
) -> tuple[Windows, Array]:
    """Windows of members (w, WINDOW_POINTS), of which the first ones are used.

    In the arrays below windows are the last axis (..., p, w): NumPy adds such long rows in half of
    the time that it takes to add within the short ones of a window each.

    Returns:
        The windows; (w,) their reliability, the larger one of inverse range and intensity.
    """
    windows = np.zeros(len(members), WINDOW)
    windows["members"], windows["count"], windows["weight"] = members, used.sum(axis=1), 1.0
    use, rows = used.T.astype(np.float64), np.ascontiguousarray(members.T)  # (p, w)
    rays_m, intensity = cloud[0].take(rows, axis=0), cloud[1].take(rows)
    inverse = 1.0 / np.sqrt(np.einsum("pwi,pwi->pw", rays_m, rays_m))
    directions = np.multiply(rays_m.transpose(2, 0, 1), inverse, order="C")  # (3, p, w)
    near = _find_silhouette(_sort(inverse, use))
    windows["front"] = (inverse >= near).T
    windows["rays_m"] = (directions / np.maximum(inverse, near)).transpose(2, 1, 0)
    places = _centre(_places(directions), use)
    trend = np.zeros_like(places) if keep_linear else _trend(places)
    relative = inverse * (windows["count"] / _sum(inverse, use))
    depth, of_depth = _normalize(relative, use, [*trend], DEPTH_NOISE)
    shade, of_shade = _normalize(intensity, use, [*trend, depth], INTENSITY_NOISE)
    for column, values in enumerate([of_depth * depth, of_shade * shade, *trend]):
        windows["basis"][..., column] = values.T
    if keep_linear:
        windows["features"] = _features(windows, use, (inverse, intensity), places)
    return windows, np.maximum(of_depth, of_shade)


def _sum(values: Array, factors: Array) -> Array:
    """(..., w) the sums of products over the points of windows; values (..., p, w)."""
    return np.asarray(np.einsum("...pw,pw->...w", values, factors))


def _sort(values: Array, use: Array) -> Array:
    """The used values of each window, the least one first; the largest one also in other places."""
    return np.sort(np.where(use > 0, values, values.max(axis=0)), axis=0)


def _find_silhouette(ordered: Array) -> Array:
    """(w,) the inverse range of the near side of a window's silhouette; 0 if it has none.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps.
    """
    gaps = np.diff(ordered, axis=0)
    at = len(gaps) - gaps[::-1].argmax(axis=0)  # the nearest
    near, far = (np.take_along_axis(ordered, i[None], axis=0)[0] for i in (at, at - 1))
    wide = near - far > SILHOUETTE_SHARE * (ordered[-1] - ordered[0])
    return np.where(wide & (near > SILHOUETTE_RATIO * far), near, 0.0)


def _places(directions: Array) -> Array:
    """(2, p, w) the directions, along circles of equal elevation and up, about the first one."""
    x, y, z = directions[:, 0]
    flat = np.hypot(x, y)
    upright = flat > 1e-9  # noqa: PLR2004
    along_x, along_y = np.where(upright, -y, 1.0), np.where(upright, x, 0.0)
    along_x, along_y = (values / np.where(upright, flat, 1.0) for values in (along_x, along_y))
    a, b, c = directions
    up = -z * along_y * a + z * along_x * b + (x * along_y - y * along_x) * c
    return np.stack([a * along_x + b * along_y, up])


def _trend(places: Array) -> Array:
    """(2, p, w) an orthonormal basis of the linear functions of direction in a window.

    Inverse range is linear in direction on any plane, and shading mostly so: without these parts
    only edges and markings are left to match. A single scan line has one such function only.
    """
    u, v = places
    uu, uv, vv = _sum(u, u), _sum(u, v), _sum(v, v)
    angle = 0.5 * np.arctan2(2 * uv, uu - vv)  # of the longer axis
    cos, sin = np.cos(angle), np.sin(angle)
    major, minor = cos * u + sin * v, cos * v - sin * u
    powers = np.stack([_sum(minor, minor), _sum(major, major)])
    kept = powers > SCAN_LINE * powers[1]
    scale = kept / np.sqrt(np.where(kept, powers, 1.0))
    return np.stack([minor * scale[0], major * scale[1]])


def _centre(values: Array, use: Array) -> Array:
    """Values (..., p, w) less their mean over the points in use; zero in the others."""
    mean = _sum(values, use) / use.sum(axis=0)
    return np.asarray((values - mean[..., None, :]) * use)


def _normalize(values: Array, use: Array, others: list[Array], noise: float) -> tuple[Array, Array]:
    """Centre and normalise values (p, w), orthogonal to other columns.

    Inverse range comes first: the part that it shares with the intensity has no reliable sign.

    Returns:
        The column; (w,) its reliability: 0 where the values are flat, 1 where they vary much.
    """
    values = _centre(values, use)
    for other in others:
        values -= _sum(values, other) * other
    power = _sum(values, values)
    column = values / np.sqrt(power + _TINY)
    return column, np.sqrt(power / (power + use.sum(axis=0) * noise**2))


def _features(windows: Windows, use: Array, values: tuple[Array, Array], places: Array) -> Array:
    """(w, f) how inverse range and intensity vary over windows, see ``FEATURES``."""
    (inverse, intensity), count = values, windows["count"]
    ordered = _sort(inverse, use)
    median = 1.0 / np.take_along_axis(ordered, count[None] // 2, axis=0)[0]
    power = np.square(windows["basis"][..., :2], dtype=np.float64).sum(axis=1)
    centred = _centre(np.stack([-np.log(inverse), *values]), use)
    spread = np.sqrt([_sum(column, column) / count for column in (*centred, *places)])
    return np.column_stack([
        power, count / len(use), np.log(median), np.log(1e-3 + spread[0]),
        _sum(1.0 - windows["front"].T, use) / count, *np.log(1e-5 + spread[3:]),
        _beside_trend(centred[1], places), _in_two_classes(ordered, count),
        np.log(1e-3 + spread[2]), _beside_trend(centred[2], places),
        _in_two_classes(_sort(intensity, use), count), 1.0 - median * inverse[0],
    ])  # fmt: skip


def _beside_trend(values: Array, places: Array) -> Array:
    """(w,) the share of the variation of centred values that no linear function follows."""
    u, v = places
    uu, uv, vv = _sum(u, u) + _TINY, _sum(u, v), _sum(v, v) + _TINY
    along_u, along_v = _sum(u, values), _sum(v, values)
    followed = vv * along_u**2 - 2 * uv * along_u * along_v + uu * along_v**2
    share = followed / ((uu * vv - uv * uv) * np.maximum(_sum(values, values), _TINY))
    return np.asarray(1.0 - np.minimum(share, 1.0))


def _in_two_classes(ordered: Array, count: NDArray[np.int32]) -> Array:
    """(w,) the largest share of the variation that lies between two classes (Otsu)."""
    k = np.arange(1, len(ordered) + 1)[:, None]
    values = ordered * (k <= count)
    total, below = values.sum(axis=0), values.cumsum(axis=0)
    between = (below - total * k / count) ** 2 * count / (k * np.maximum(count - k, 1))
    variation = _sum(values, values) - total**2 / count
    share = (between * (k < count)).max(axis=0) / np.maximum(variation, _TINY)
    return np.where(variation > _TINY, share, 0.0)
