"""Factors of poses alone: the paper's two priors, measured relative poses; custom factors.

All act on variables ``X = T_lidar_camera``. GTSAM's cost is half the squared whitened error, so a
paper weight lambda is a sigma of 1 / sqrt(lambda).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.arrays import BlockSums, square_root

Array = NDArray[np.float64]
SumsAt = Callable[..., tuple[BlockSums, Array | None]]


def custom_factor(
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    linearize: Callable[[gtsam.Values], tuple[Array, Sequence[Array]]],
) -> gtsam.CustomFactor:
    """A factor whose error, and its Jacobians by the variables of the keys, a function gives."""

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        found, by_variables = linearize(values)
        if jacobians is not None:
            for number, jacobian in enumerate(by_variables):
                jacobians[number] = np.asfortranarray(jacobian)
        return found

    return gtsam.CustomFactor(noise, list(keys), error)


def lossless_factor(
    keys: Sequence[int], sums_at: SumsAt, *, rows: int | None = None, columns: int = 0
) -> gtsam.CustomFactor:
    """Robust residuals as one factor, equal to the separate ones, by their sums.

    It remembers its last result: an optimizer evaluates the error of a step and then linearizes at
    the same place, which takes one pass over the correspondences. Place and result are replaced as
    one tuple, so that threads never see those with the result of others.

    Args:
        keys: of poses; the last of a vector, if there are columns.
        sums_at: the sums at these variables, and (r, n) derivatives of what these are by.
        rows: r; None: the sums are by the variables themselves.
        columns: size of the vector.
    """
    poses = len(keys) - (columns > 0)
    edges = [*range(0, 6 * len(keys), 6), 6 * poses + columns]
    parts = [slice(*both) for both in pairwise(edges)]
    noise = gtsam.noiseModel.Unit.Create(1 + (6 * poses + columns if rows is None else rows))
    last: tuple[bytes, tuple[Array, list[Array]]] | None = None

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        nonlocal last
        at: list[Any] = [values.atPose3(key) for key in keys[:poses]]
        numbers = [pose.matrix() for pose in at]
        if columns:
            at.append(values.atVector(keys[-1]))
            numbers.append(at[-1])
        place, found = b"".join(part.tobytes() for part in numbers), last
        if found is None or found[0] != place:
            sums, chain = sums_at(*at)
            error, jacobian = square_root(sums)
            jacobian = jacobian if chain is None else jacobian @ chain
            last = found = place, (error, [jacobian[:, part] for part in parts])
        return found[1]

    return custom_factor(noise, keys, linearize)


def cauchy_noise(base: gtsam.noiseModel.Gaussian, scale: float) -> gtsam.noiseModel.Base:
    """GTSAM's stock noise model with Cauchy's loss, which bends at a whitened norm, if finite."""
    if np.isinf(scale):
        return base
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(scale)
    return gtsam.noiseModel.Robust.Create(loss, base)


def linear_factor(
    keys: Sequence[int], matrices: Sequence[Array], noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """A factor on vectors, whose error is the sum of matrices times them."""

    def linearize(values: gtsam.Values) -> tuple[Array, Sequence[Array]]:
        pairs = zip(matrices, map(values.atVector, keys), strict=True)
        return np.asarray(sum(matrix @ vector for matrix, vector in pairs)), matrices

    return custom_factor(noise, keys, linearize)


def pose_sigmas(*, rotation_rad: float, translation_m: float) -> Array:
    """(6,) standard deviations in GTSAM's tangent order: rotation first, then translation."""
    return np.array([rotation_rad] * 3 + [translation_m] * 3)


def camera_prior_factor(
    key: int, T_camera_lidar: ArrayLike, *, weight: float
) -> gtsam.PriorFactorPose3:
    """The paper's per-camera prior ``lambda |log(T_hat^-1 T)|^2``, T = T_camera_lidar.

    Exactly, not to first order: with X = T^-1 the stock prior's error is
    ``log(T_hat X) = -Ad(T_hat) log(T_hat^-1 T)``, so its covariance must be Ad(T_hat) Ad(T_hat)^T
    / lambda, and the root of its information Ad(T_hat)^-1 sqrt(lambda).

    Args:
        key: the pose variable ``T_lidar_camera``.
        T_camera_lidar: (4, 4) the prior's mean T_hat.
        weight: lambda > 0.
    """
    mean = gtsam.Pose3(np.asarray(T_camera_lidar, dtype=np.float64))
    root = weight**0.5 * mean.inverse().AdjointMap()
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
    return gtsam.PriorFactorPose3(key, mean.inverse(), noise)


def relative_prior_factor(
    key_1: int, key_2: int, T_camera2_camera1: ArrayLike, *, weight: float
) -> gtsam.BetweenFactorPose3:
    """The paper's relative prior ``mu |log(T_hat_12^-1 T_2 T_1^-1)|^2``.

    Args:
        key_1: variable of camera 1.
        key_2: variable of camera 2.
        T_camera2_camera1: (4, 4) T_hat_12 = T_hat_2 T_hat_1^-1.
        weight: mu > 0.
    """
    measured = gtsam.Pose3(np.asarray(T_camera2_camera1, dtype=np.float64))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, weight**-0.5)
    return gtsam.BetweenFactorPose3(key_2, key_1, measured, noise)


def relative_pose_factor(
    key_a: int,
    key_b: int,
    T_a_b: ArrayLike,
    *,
    rotation_sigma_rad: float,
    translation_sigma_m: float,
) -> gtsam.BetweenFactorPose3:
    """A measured relative pose: stereo calibration, CAD, a Kalibr camchain.

    Args:
        key_a: variable of camera a.
        key_b: variable of camera b.
        T_a_b: (4, 4) maps coordinates in b to coordinates in a.
        rotation_sigma_rad: standard deviation about each axis of b.
        translation_sigma_m: standard deviation along each axis of b.
    """
    measured = gtsam.Pose3(np.asarray(T_a_b, dtype=np.float64))
    sigmas = pose_sigmas(rotation_rad=rotation_sigma_rad, translation_m=translation_sigma_m)
    return gtsam.BetweenFactorPose3(
        key_a, key_b, measured, gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )


def displaced_between_factor(
    key_1: int, key_2: int, shifts: Mapping[int, Array], noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Two poses that differ by some vectors' effect: error ``log(X_1^-1 X_2) - sum shifts b``.

    Args:
        key_1: variable X_1.
        key_2: variable X_2.
        shifts: by the key of each vector b, (6, B) twist of X_2 in X_1's frame by its numbers.
        noise: of the six rows.
    """

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        step = values.atPose3(key_1).between(values.atPose3(key_2))
        twist = gtsam.Pose3.Logmap(step)
        by_step = gtsam.Pose3.LogmapDerivative(twist)
        by_first = -by_step @ step.inverse().AdjointMap()
        left = np.asarray(twist - sum(s @ values.atVector(key) for key, s in shifts.items()))
        return left, [by_first, *(-s for s in shifts.values()), by_step]

    return custom_factor(noise, [key_1, *shifts, key_2], linearize)
