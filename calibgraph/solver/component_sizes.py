"""The sizes of the error's components that the data show: REML, by Schall's fixed point.

With e the displacement of a latent pose at the minimum and S its usual covariance, a component of
size s has  sum e^T S^-1 e = s (6 n - trace)  in the mean, where the trace is what the data leave
open: of the posterior covariance of all e, in units of s S. What is usual takes part as some more
degrees of freedom. Where nothing is measured twice (one place, no pairs of cameras, no relative
poses) e is 0, the trace is 6 n, and the size is the usual one.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.error_components import error_components
from calibgraph.solver.hierarchy import Components, Hierarchy
from calibgraph.solver.hierarchy_fit import HierarchyFit
from calibgraph.solver.hierarchy_poses import placed_edges, shared_edges

Array = NDArray[np.float64]

_SETTLED = 0.1  # relative change of the sizes: the data leave far more open


@dataclass(frozen=True)
class Sizes:
    """Variances over the usual ones.

    Attributes:
        shared: of what all places share: the cloud, its bends, the cameras' matches, their pairs.
        cloud: of the cloud at one place.
        cameras: of a camera's matches at one place.
    """

    shared: float = 1.0
    cloud: float = 1.0
    cameras: float = 1.0

    def scale(self, usual: Components) -> Components:
        """Components of these sizes."""
        return replace(
            usual,
            cloud=self.shared * usual.cloud,
            camera=self.shared * usual.camera,
            bend_size=self.shared * usual.bend_size,
            pairs=self.shared * usual.pairs,
            cloud_at_place=self.cloud * usual.cloud_at_place,
            at_place=self.cameras * usual.at_place,
            scatter_at_place=self.cameras * usual.scatter_at_place,
        )

    def is_near(self, other: Sizes) -> bool:
        """Whether all are the same but for some percent."""
        return np.allclose(astuple(self), astuple(other), rtol=_SETTLED, atol=0.0)


def sizes_of(model: Hierarchy, fit: HierarchyFit, present: Sizes) -> Sizes:
    """The sizes that a fit shows.

    What is shared everywhere is never taken for smaller than usual: what displaces all cameras
    alike is not seen. Nor is what places share, where there are few of them.

    Args:
        model: of the present sizes.
        fit: its minimum.
        present: of the model.
    """
    squared, free = _placed_evidence(model, fit)
    return sizes_by_evidence(
        _shared_evidence(model, fit),
        Evidence(float(squared[0]), float(free[0])),
        Evidence(float(squared[1:].sum()), float(free[1:].sum())),
        places=model.places,
        present=present,
    )


class Evidence(NamedTuple):
    """Of one component.

    Attributes:
        squared: sum of squares of its displacements, in units of its present covariance.
        free: what is expected of that, at the present size.
    """

    squared: float
    free: float


def sizes_by_evidence(
    shared: Evidence, cloud: Evidence, cameras: Evidence, *, places: int, present: Sizes
) -> Sizes:
    """The sizes by each component's evidence, as `sizes_of`; ``places``: how many there are."""
    prior = error_components()
    least = 1.0 if places < prior.least_places else 0.0
    return Sizes(
        max(_size(shared, present.shared, prior.shared_dof), 1.0),
        max(_size(cloud, present.cloud, prior.place_dof), least),
        max(_size(cameras, present.cameras, prior.place_dof), least),
    )


def _size(evidence: Evidence, present: float, prior_dof: float) -> float:
    """The size by squares in units of the present one, with the usual one as prior."""
    return (prior_dof + present * evidence.squared) / (prior_dof + max(evidence.free, 0.0))


def _shared_evidence(model: Hierarchy, fit: HierarchyFit) -> Evidence:
    """Of what is shared everywhere."""
    edges, free = shared_edges(model, fit.poses), len(fit.shared_covariance)
    jacobian = edges.jacobian[:, :free]  # the identity is known
    trace = np.sum((edges.information @ jacobian) * (jacobian @ fit.shared_covariance))
    return Evidence(edges.squared, float(len(edges.error) - trace))


def _placed_evidence(model: Hierarchy, fit: HierarchyFit) -> tuple[Array, Array]:
    """(1 + N,) the same of the cloud and of each camera at places, by their weights in the loss."""
    edges = placed_edges(model, fit.poses)
    weighted = edges.information * edges.weight[:, None, None]
    P, L = fit.distances.shape
    slope = fit.place_slope.reshape(P, L, 6, -1)
    # The place's pose is -slope times the shared ones, and varies about it by itself.
    gain = -edges.to_second @ slope.reshape(P * L, 6, -1)
    columns = 6 * edges.first[:, None, None] + np.arange(6)
    number = np.arange(P * L)[:, None, None]
    gain[number, np.arange(6)[:, None], columns] += edges.to_first
    own = fit.place_covariance.reshape(P, L, 6, L, 6)[:, np.arange(L), :, np.arange(L)]
    own = own.swapaxes(0, 1).reshape(P * L, 6, 6)
    known = gain @ fit.shared_covariance @ gain.transpose(0, 2, 1)
    known += edges.to_second @ own @ edges.to_second.transpose(0, 2, 1)
    traces = (weighted * known).sum(axis=(1, 2))
    squared = (edges.weight * edges.squared).reshape(P, L).sum(axis=0)
    return squared, (6.0 * edges.weight - traces).reshape(P, L).sum(axis=0)
