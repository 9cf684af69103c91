"""The sizes of the error's components that the data show: REML, by Schall's fixed point.

With e the displacement of a latent pose at the minimum and S its usual covariance, a component of
size s has  sum e^T S^-1 e = s (6 n - trace)  in the mean, where the trace is what the data leave
open: of the posterior covariance of all e, in units of s S. What is usual takes part as some more
degrees of freedom. Where nothing is measured twice (one place, no pairs of cameras, no relative
poses) e is 0, the trace is 6 n, and the size is the usual one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.error_components import error_components
from calibgraph.solver.hierarchy import Components, Hierarchy
from calibgraph.solver.hierarchy_fit import HierarchyFit, placed_edges, shared_edges

Array = NDArray[np.float64]


def sized_components(
    usual: Components, model: Hierarchy, fit: HierarchyFit
) -> tuple[Components, tuple[float, float]]:
    """The usual components, times the sizes that a fit shows.

    What is shared everywhere is never taken for smaller than usual: what displaces all cameras
    alike is not seen. Nor is what places share, where there are few of them.

    Args:
        usual: of size 1.
        model: of the present sizes.
        fit: its minimum.

    Returns:
        The components; the sizes of what is shared everywhere, and of places.
    """
    prior, present = error_components(), model.components
    shared = _size(
        *_shared_evidence(model, fit), present.cloud[0, 0] / usual.cloud[0, 0], prior.shared_dof
    )
    placed = _size(
        *_placed_evidence(model, fit),
        present.cloud_at_place[0, 0] / usual.cloud_at_place[0, 0],
        prior.place_dof,
    )
    shared = max(shared, 1.0)
    if model.places < prior.least_places:
        placed = max(placed, 1.0)
    sized = replace(
        usual,
        cloud=shared * usual.cloud,
        camera=shared * usual.camera,
        pairs=shared * usual.pairs,
        cloud_at_place=placed * usual.cloud_at_place,
        at_place=placed * usual.at_place,
    )
    return sized, (shared, placed)


def _size(squared: float, free: float, present: float, prior_dof: float) -> float:
    """The size by squares in units of the present one, with the usual one as prior."""
    return (prior_dof + present * squared) / (prior_dof + max(free, 0.0))


def _shared_evidence(model: Hierarchy, fit: HierarchyFit) -> tuple[float, float]:
    """Sum of squares of what is shared everywhere, and its expectation."""
    edges = shared_edges(model, fit.poses)
    free = len(fit.shared_covariance)
    covariance = np.zeros((free + 6, free + 6))  # the identity is known
    covariance[:free, :free] = fit.shared_covariance
    blocks = covariance.reshape(free // 6 + 1, 6, free // 6 + 1, 6).swapaxes(1, 2)
    both = np.concatenate([edges.to_first, edges.to_second], axis=2)
    ends = np.stack([edges.first, edges.second], axis=1)
    known = blocks[ends[:, :, None], ends[:, None, :]].swapaxes(2, 3).reshape(-1, 12, 12)
    trace = np.einsum("nij,njk,nkl,nil->", edges.information, both, known, both, optimize=True)
    return float(edges.squared.sum()), 6.0 * len(edges.error) - float(trace)


def _placed_evidence(model: Hierarchy, fit: HierarchyFit) -> tuple[float, float]:
    """The same of places, by their weights in the loss."""
    edges = placed_edges(model, fit.poses)
    weighted = edges.information * edges.weight[:, None, None]
    P, L = fit.distances.shape
    slope = fit.place_slope.reshape(P, L, 6, -1)
    own, trace = fit.place_covariance, 0.0
    for number in range(P * L):
        place, local, shared = number // L, number % L, 6 * edges.first[number]
        # The place's pose is -slope times the shared ones, and varies about it by itself.
        gain = -edges.to_second[number] @ slope[place, local]
        gain[:, shared : shared + 6] += edges.to_first[number]
        rows = slice(6 * local, 6 * local + 6)
        by_itself = edges.to_second[number] @ own[place, rows, rows] @ edges.to_second[number].T
        known = gain @ fit.shared_covariance @ gain.T + by_itself
        trace += float(np.sum(weighted[number] * known))
    squared = float((edges.weight * edges.squared).sum())
    return squared, 6.0 * float(edges.weight.sum()) - trace
