"""The error that all frames of a recording share, which the scatter between frames cannot show."""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import pose_rows, relative_transform, twist_between
from calibgraph.solver.camera_pairs import ENOUGH_SURFACES
from calibgraph.solver.pair_refinement import PairFit


def with_common_error(table: Correspondences, config: Config) -> Correspondences:
    """The table with the common error of the settings in its metadata, if they have one.

    Raises:
        CorrespondenceError: if the table states another one.
    """
    if (config.common_deg, config.common_cm) == (None, None):
        return table
    rotation_rad, translation_m = np.radians(config.common_deg or 0), (config.common_cm or 0) / 100
    wanted, found = (float(rotation_rad), translation_m), table.findings
    if not found.states_common_error:
        return table.with_findings(
            MatcherFindings(systematic_rotation_rad=wanted[0], systematic_translation_m=wanted[1])
        )
    if found.systematic_sigmas != wanted:
        rotation_rad, translation_m = found.systematic_sigmas
        raise CorrespondenceError(
            f"the table states that its frames share {np.degrees(rotation_rad):.3g} deg and "
            f"{100 * translation_m:.3g} cm; leave common_deg and common_cm out"
        )
    return table


def shared_variance_ratio(
    T_camera_lidar: Mapping[str, Array], covariance: Array, fits: Sequence[PairFit]
) -> float:
    """Variance of the shared error over its usual one, by what cameras see in common; at least 1.

    The correspondences place each camera by itself; images place them relative to each other, much
    better. The difference, over pairs that span each group of tied cameras, is chi-squared
    distributed if the covariances are right, with six degrees of freedom per pair. The usual size
    counts as six of them. It is never taken for less than usual: what displaces all cameras alike
    is not seen between them.

    Args:
        T_camera_lidar: (4, 4) of all cameras, by their correspondences.
        covariance: (6 N, 6 N) of these.
        fits: where the images place them.
    """
    cameras, chosen = list(T_camera_lidar), _spanning(fits)
    if not chosen:
        return 1.0
    apart, to_pairs, of_images = [], [], np.zeros((6 * len(chosen), 6 * len(chosen)))
    for number, fit in enumerate(chosen):
        T_b_a = relative_transform(T_camera_lidar[fit.b], T_camera_lidar[fit.a])
        apart.append(twist_between(T_b_a, fit.T_b_a))
        to_pair = np.zeros((6, len(covariance)))
        to_pair[:, pose_rows(cameras.index(fit.a))] = -gtsam.Pose3(T_b_a).AdjointMap()
        to_pair[:, pose_rows(cameras.index(fit.b))] = np.eye(6)
        to_pairs.append(to_pair)
        of_images[pose_rows(number), pose_rows(number)] = fit.covariance
    jacobian, step = np.concatenate(to_pairs), np.concatenate(apart)
    whole = jacobian @ covariance @ jacobian.T + of_images
    chi_squared = float(step @ np.linalg.solve(whole, step))
    usual_dof = error_components().shared_dof
    return max(1.0, (usual_dof + chi_squared) / (usual_dof + len(step)))


def _spanning(fits: Sequence[PairFit]) -> list[PairFit]:
    """Pairs that tie each group of cameras once: those with the most features first."""
    body: dict[str, str] = {}
    chosen = []
    for fit in sorted(fits, key=lambda fit: -fit.features):
        one, two = (body.setdefault(name, name) for name in (fit.a, fit.b))
        if one != two and fit.features >= ENOUGH_SURFACES:
            chosen.append(fit)
            body = {name: one if of == two else of for name, of in body.items()}
    return chosen
