"""GTSAM's custom factors: from a function of the values to its error and Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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


def linear_factor(
    keys: Sequence[int], matrices: Sequence[Array], noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """A factor on vectors, whose error is the sum of matrices times them."""

    def linearize(values: gtsam.Values) -> tuple[Array, Sequence[Array]]:
        pairs = zip(matrices, map(values.atVector, keys), strict=True)
        return np.asarray(sum(matrix @ vector for matrix, vector in pairs)), matrices

    return custom_factor(noise, keys, linearize)
