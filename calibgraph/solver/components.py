"""The variance components: their priors, and REML estimates by Schall's fixed point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.components import (
    EXACT,
    VarianceComponents,
    VarianceRatios,
    least_cost_of_distortion,
)
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.solver.columns import DistortionEvidence
from calibgraph.solver.pair_refinement import pair_sigmas
from calibgraph.solver.places import Linearization
from calibgraph.solver.within_place import WithinPlace

Component = Literal["shared", "cloud", "cameras"]


class Evidence(NamedTuple):
    """Evidence about one component.

    Attributes:
        squared: sum of squares of its displacements, in units of its present covariance.
        free: n - t, expectation of ``squared`` at the present ratio.
    """

    squared: float
    free: float


def estimate_variance_ratios(linear: Linearization, present: VarianceRatios) -> VarianceRatios:
    """One step of the fixed point.

    The shared ratio is never below its prior: a displacement of all cameras alike is not observed.
    Neither are those of places, where there are few of them.

    Args:
        linear: with the present ratios.
        present: the ratios of its model.
    """
    evidence, places = squared_displacements(linear), linear.model.places
    without = {name: one._replace(free=0.0) for name, one in evidence.items()}
    for known in (without, evidence):  # the range, whatever the data leave open
        if not ratios_by_evidence(known, places=places, present=present).is_near(present):
            break
    else:
        return present
    for name, t in undetermined(linear).items():
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


def squared_displacements(linear: Linearization) -> dict[Component, Evidence]:
    """Per component its weighted sum of squares, and its number n of degrees of freedom."""
    model, parts = linear.model, linear.model.components
    variables, distortions, known = 1 + len(model.matched) + len(model.paired), 0, 0.0
    if model.is_distorted:  # its residuals count as a part of its prior
        distortions, known = parts.distortion_jacobian.shape[2], least_cost_of_distortion(parts)
    weight = linear.ties.weight
    squared = weight * linear.ties.distance**2
    return {
        "shared": Evidence(
            2.0 * model.error_graph.error(linear.shared) - known, 6.0 * variables + distortions
        ),
        "cloud": Evidence(float(squared[0].sum()), 6.0 * float(weight[0].sum())),
        "cameras": Evidence(float(squared[1:].sum()), 6.0 * float(weight[1:][model.present].sum())),
    }


def undetermined(linear: Linearization) -> dict[Component, float]:
    """Per component t, the degrees of freedom that the data leave open: tr(S^-1 Cov(e)).

    The losses of places count with the weights that they have.
    """
    joint, places = linear.joint_covariance, linear.places
    errors = linear.hessian_of(linear.model.error_graph.linearize(linear.shared))[0]
    known = joint[: linear.model.touched, : linear.model.touched]
    return {
        "shared": float((errors * joint).sum()),
        "cloud": float(places.cloud.open_freedom(known).sum()),
        "cameras": float(places.cameras.open_freedom(known)[linear.model.present].sum()),
    }


def variance_components(
    findings: MatcherFindings,
    cameras: Sequence[str],
    shown: Mapping[str, tuple[WithinPlace, DistortionEvidence | None]],
    *,
    places: int,
    rigid: tuple[Array, Array],
) -> VarianceComponents:
    """The prior components, but for the pairs' part of the scan distortion.

    Args:
        findings: of the matcher, with the sizes of its errors.
        cameras: of the rig.
        shown: per camera that has correspondences, what these share by the scatter of frames, and
            their quadratics in the scan distortion.
        places: number of places.
        rigid: by :func:`common_error`.
    """
    prior, sigmas = error_components(), np.asarray(findings.bend_sigmas)
    at_place = np.tile(np.eye(6), (places, len(cameras), 1, 1))
    scatter_at_place, jacobian = at_place.copy(), np.zeros((len(cameras), 6, len(sigmas)))
    vector, information = np.zeros(len(sigmas)), np.zeros((len(sigmas), len(sigmas)))
    for name, (within, evidence) in shown.items():
        number = cameras.index(name)
        at_place[:, number] = within.at_place(findings.place_variance)
        stated = findings.place_variance > 0
        scatter_at_place[:, number] = within.at_place(0.0) if stated else at_place[:, number]
        if evidence is not None:
            jacobian[number] = evidence.jacobian * sigmas
            weight = 1.0 / within.mean_variance(findings.place_variance)
            information += weight * np.outer(sigmas, sigmas) * evidence.information
            vector += weight * sigmas * evidence.vector
    of_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
    return VarianceComponents(
        cloud=rigid[0],
        cloud_at_place=pose_covariance(*of_place),
        camera=rigid[1],
        pairs=pose_covariance(*(pair_sigmas()[[0, 3]] ** 2 / 2)),
        at_place=at_place,
        scatter_at_place=scatter_at_place,
        distortion_jacobian=jacobian,
        pair_distortion_jacobian=np.zeros_like(jacobian),
        distortion_information=information,
        distortion_vector=vector,
        robust_scale=prior.robust_sigmas if places >= prior.robust_places else np.inf,
    )


def common_error(sigmas: tuple[float, float], camera_share: float) -> tuple[Array, Array]:
    """(6, 6) covariances of the rigid error that all frames share: of cloud and camera."""
    of_cloud, of_camera = np.outer([1.0 - camera_share, camera_share], np.square(sigmas))
    return pose_covariance(*of_cloud), pose_covariance(*of_camera)


def pose_covariance(rotation_rad2: float, translation_m2: float) -> Array:
    """(6, 6), positive definite, from the variance per axis."""
    return np.diag(np.maximum(np.repeat([rotation_rad2, translation_m2], 3), EXACT**2))
