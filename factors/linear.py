"""A factor that is linear in vectors."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def linear_factor(
    keys: Sequence[int], matrices: Sequence[Array], noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """A factor on vectors, whose error is the sum of matrices times them."""

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        if jacobians is not None:
            for number, matrix in enumerate(matrices):
                jacobians[number] = np.asfortranarray(matrix)
        vectors = (values.atVector(key) for key in keys)
        return np.asarray(sum(m @ v for m, v in zip(matrices, vectors, strict=True)))

    return gtsam.CustomFactor(noise, list(keys), error)
