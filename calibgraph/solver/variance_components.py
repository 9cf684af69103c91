"""The variance components: their priors, and REML estimates by Schall's fixed point.

With e the displacements of a component at the optimum and S their prior covariance, a component of
variance ratio s has  sum e^T S^-1 e = s (n - t)  in the mean, where n is the number of its degrees
of freedom and  t = -d log det H / d log s  the part of these that the data leave open; H is the
Hessian of the whole graph. The prior ratio takes part as further degrees of freedom. Where nothing
is measured twice (one place, no pairs of cameras, no relative poses) e is 0, t is n, and the ratio
is the prior one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Literal, NamedTuple

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.components import EXACT, VarianceComponents, least_cost_of_distortion
from calibgraph.graph.latent_poses import to_ordering
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.solver.columns import DistortionEvidence
from calibgraph.solver.elimination import LatentPoseFit, Linearization, join_linear
from calibgraph.solver.pair_refinement import pair_sigmas
from calibgraph.solver.within_place import WithinPlace

Component = Literal["shared", "cloud", "cameras"]

_SETTLED = 0.1  # relative change of the ratios: the data leave far more open
_DIFFERENCE = 1e-3  # of log ratios


@dataclass(frozen=True)
class VarianceRatios:
    """Variances over their priors.

    Attributes:
        shared: of what all places share: the cloud, its distortion, the cameras' matches and pairs.
        cloud: of the cloud at one place.
        cameras: of a camera's matches at one place.
    """

    shared: float = 1.0
    cloud: float = 1.0
    cameras: float = 1.0

    def scale(self, prior: VarianceComponents) -> VarianceComponents:
        """Components of these ratios."""
        return replace(
            prior,
            cloud=self.shared * prior.cloud,
            camera=self.shared * prior.camera,
            pairs=self.shared * prior.pairs,
            distortion_size=self.shared * prior.distortion_size,
            cloud_at_place=self.cloud * prior.cloud_at_place,
            at_place=self.cameras * prior.at_place,
            scatter_at_place=self.cameras * prior.scatter_at_place,
        )

    def is_near(self, other: VarianceRatios) -> bool:
        """Whether all are the same to some percent."""
        pairs = zip(astuple(self), astuple(other), strict=True)
        return all(abs(one - two) <= _SETTLED * abs(two) for one, two in pairs)


class Evidence(NamedTuple):
    """Evidence about one component.

    Attributes:
        squared: sum of squares of its displacements, in units of its present covariance.
        free: n - t, expectation of ``squared`` at the present ratio.
    """

    squared: float
    free: float


def estimate_variance_ratios(fit: LatentPoseFit, present: VarianceRatios) -> VarianceRatios:
    """One step of the fixed point.

    The shared ratio is never below its prior: a displacement of all cameras alike is not observed.
    Neither are those of places, where there are few of them.

    Args:
        fit: with the present ratios.
        present: the ratios of its model.
    """
    evidence, places = squared_displacements(fit), fit.linear.model.places
    least = ratios_by_evidence(evidence, places=places, present=present)
    without = {name: one._replace(free=0.0) for name, one in evidence.items()}
    most = ratios_by_evidence(without, places=places, present=present)
    if least.is_near(present) and most.is_near(present):  # whatever the data leave open
        return most
    for name, t in undetermined(_with_fixed_weights(fit)).items():
        evidence[name] = evidence[name]._replace(free=evidence[name].free - t)
    return ratios_by_evidence(evidence, places=places, present=present)


def ratios_by_evidence(
    evidence: Mapping[Component, Evidence], *, places: int, present: VarianceRatios
) -> VarianceRatios:
    """The ratios by each component's evidence; ``places`` is their number."""
    prior = error_components()
    least = 1.0 if places < prior.least_places else 0.0

    def ratio(name: Component, dof: float) -> float:
        before: float = getattr(present, name)
        return (dof + before * evidence[name].squared) / (dof + max(evidence[name].free, 0.0))

    return VarianceRatios(
        max(ratio("shared", prior.shared_dof), 1.0),
        max(ratio("cloud", prior.place_dof), least),
        max(ratio("cameras", prior.place_dof), least),
    )


def squared_displacements(fit: LatentPoseFit) -> dict[Component, Evidence]:
    """Per component its weighted sum of squares, and its number n of degrees of freedom."""
    linear = fit.linear
    model, parts = linear.model, linear.model.components
    weight = fit.place_weights(parts.robust_scale)
    squared = weight * linear.distances**2
    present = np.zeros(squared.shape, dtype=np.bool_)
    for place, number in model.matched_places:
        present[place, 1 + number] = True
    variables, distortions, known = 1 + len(model.matched) + len(model.paired), 0, 0.0
    if model.is_distorted:  # its residuals count as a part of its prior
        distortions, known = parts.distortion_jacobian.shape[2], least_cost_of_distortion(parts)
    return {
        "shared": Evidence(
            2.0 * model.error_graph.error(linear.values) - known, 6.0 * variables + distortions
        ),
        "cloud": Evidence(squared[:, 0].sum(), 6.0 * weight[:, 0].sum()),
        "cameras": Evidence(squared[:, 1:].sum(), 6.0 * weight[present].sum()),
    }


def undetermined(linear: Linearization) -> dict[Component, float]:
    """Per component t, the degrees of freedom that the data leave open.

    Args:
        linear: with quadratic losses of places.
    """
    model, values = linear.model, linear.values

    def shared(ratio: float) -> float:
        parts = VarianceRatios(shared=ratio).scale(model.components)
        parts = replace(parts, distortion_weight=parts.distortion_weight / ratio)
        scaled = replace(model, components=parts)
        graph = join_linear(scaled.shared_graph.linearize(values), linear.left_by_places)
        return log_determinant(graph, to_ordering(model.shared_keys))

    def placed(**ratio: float) -> float:
        parts = VarianceRatios(**ratio).scale(model.components)
        scaled = replace(model, components=parts).place_graph.linearize(values)
        graph = join_linear(linear.shared, scaled, linear.data.graph)
        return log_determinant(graph, model.ordering)

    up, down = np.exp(_DIFFERENCE), np.exp(-_DIFFERENCE)
    return {
        "shared": (shared(down) - shared(up)) / (2 * _DIFFERENCE),
        "cloud": (placed(cloud=down) - placed(cloud=up)) / (2 * _DIFFERENCE),
        "cameras": (placed(cameras=down) - placed(cameras=up)) / (2 * _DIFFERENCE),
    }


def log_determinant(graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> float:
    """The log of the determinant of the graph's Hessian."""
    return 2.0 * float(graph.eliminateSequential(ordering).logDeterminant())


def _with_fixed_weights(fit: LatentPoseFit) -> Linearization:
    """The graph with quadratic losses of the curvature that the robust ones have."""
    model, scale = fit.linear.model, fit.linear.model.components.robust_scale
    if np.isinf(scale):
        return fit.linear
    fixed = model.components.with_fixed_weights(fit.place_weights(scale))
    return replace(fit.linear, model=replace(model, components=fixed))


def variance_components(
    findings: MatcherFindings,
    cameras: Sequence[str],
    shown: Mapping[str, tuple[WithinPlace, DistortionEvidence | None]],
    *,
    places: int,
) -> VarianceComponents:
    """The prior components, but for the pairs' part of the scan distortion.

    Args:
        findings: of the matcher, with the sizes of its errors.
        cameras: of the rig.
        shown: per camera that has correspondences, what these share by the scatter of frames, and
            their quadratics in the scan distortion.
        places: number of places.
    """
    prior, sigmas = error_components(), np.asarray(findings.bend_sigmas)
    at_place = np.tile(np.eye(6), (places, len(cameras), 1, 1))
    scatter_at_place, jacobian = at_place.copy(), np.zeros((len(cameras), 6, len(sigmas)))
    shape = places, len(cameras), len(sigmas)
    vector, information = np.zeros(shape), np.zeros((*shape, shape[2]))
    for name, (within, evidence) in shown.items():
        number = cameras.index(name)
        at_place[:, number] = within.at_place(findings.place_variance)
        stated = findings.place_variance > 0
        scatter_at_place[:, number] = within.at_place(0.0) if stated else at_place[:, number]
        if evidence is not None:
            jacobian[number] = evidence.jacobian * sigmas
            weight = 1.0 / within.mean_variance(findings.place_variance)
            information[:, number] = weight * np.outer(sigmas, sigmas) * evidence.information
            vector[:, number] = weight * sigmas * evidence.vector
    of_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
    components = VarianceComponents(
        cloud=np.eye(6),
        cloud_at_place=pose_covariance(*of_place),
        camera=np.eye(6),
        pairs=pose_covariance(*(pair_sigmas()[[0, 3]] ** 2 / 2)),
        at_place=at_place,
        scatter_at_place=scatter_at_place,
        distortion_jacobian=jacobian,
        pair_distortion_jacobian=np.zeros_like(jacobian),
        distortion_information=information,
        distortion_vector=vector,
        distortion_weight=np.ones(shape[:2]),
        robust_scale=prior.robust_sigmas if places >= prior.robust_places else np.inf,
    )
    return common_error(components, findings.rigid_sigmas, findings.camera_share)


def common_error(
    components: VarianceComponents, sigmas: tuple[float, float], camera_share: float
) -> VarianceComponents:
    """The components with a rigid error that all frames share, of the cloud and of each camera."""
    whole = np.square(sigmas)
    return replace(
        components,
        cloud=pose_covariance(*((1.0 - camera_share) * whole)),
        camera=pose_covariance(*(camera_share * whole)),
    )


def pose_covariance(rotation_rad2: float, translation_m2: float) -> Array:
    """(6, 6), positive definite, from the variance per axis."""
    return np.diag(np.maximum(np.repeat([rotation_rad2, translation_m2], 3), EXACT**2))
