"""The variance components of the error model before the data refine them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.components import EXACT, VarianceComponents
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.solver.pair_refinement import pair_sigmas
from calibgraph.solver.scan_distortion import DistortionEvidence
from calibgraph.solver.within_place import WithinPlace


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
