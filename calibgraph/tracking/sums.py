"""Sums over frames: the one statistic that is left of matches, of epochs, places and halves alike.

Near a reference T_lidar_camera, half the cost of a block of correspondences is
``d^T H d / 2 + b^T d + c`` for the tangent step d from the reference. Such sums add: thousands of
frames are one (H, b). H is the true Hessian of the robust cost: with it the step to the minimum is
exact to second order, while with the reweighted Hessian it is 20 to 40 percent too short. The
scatter ``B = sum g g^T`` of the frames' gradients is summed too: ``H^-1 B H^-1`` is the covariance.

If the extrinsic may have walked by a covariance Q since, then

    H' = (H^-1 + Q / k)^-1 = G H,   b' = G b,   B' = G B G^T + H' Q H'

so that ``H'^-1 B' H'^-1 = H^-1 B H^-1 + Q`` exactly, whatever the gain. k, the mean eigenvalue of
``H^-1 B`` per frame, is the overconfidence of H: matches of a frame share errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.objective import join
from calibgraph.graph.variables import camera_key
from calibgraph.solver.covariance import convex_hessian
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import ResidualScale
from factors import smallest_scaled_eigenvalue, smallest_scaled_eigenvalues

_POSE = 6
_SQUARE, _SIZE = _POSE * _POSE, _POSE * (3 * _POSE + 2) + 2
_STEPS = 2  # of Gauss-Newton on quadratics: the second is of rounding, but for priors far away
_LEAST_EIGENVALUE = 1e-9  # of the unit-diagonal Hessian: rounding noise is near 1e-15


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over frames. The leading axes (...), of cameras, places or others, are alike in all.

    What is summed are views of one array, so that adding is one operation.

    Attributes:
        packed: (..., 122) of the properties, one after the other.
    """

    packed: Array

    @staticmethod
    def of(**values: Array) -> Sums:
        """Of all the properties."""
        return Sums.zeros(*values["frames"].shape).change(**values)

    @staticmethod
    def zeros(*shape: int) -> Sums:
        """Over no frames, with these leading axes."""
        return Sums(np.zeros((*shape, _SIZE)))

    @property
    def hessian(self) -> Array:
        """(..., 6, 6) true Hessian of the robust cost, in the tangent of T_lidar_camera."""
        return self._matrix(0)

    @property
    def reweighted(self) -> Array:
        """(..., 6, 6) Hessian by the matches' weights in the loss.

        It is positive semidefinite, of however few.
        """
        return self._matrix(1)

    @property
    def scatter(self) -> Array:
        """(..., 6, 6) sum of the outer products of the gradients of ``score``."""
        return self._matrix(2)

    @property
    def gradient(self) -> Array:
        """(..., 6) at the reference, which ``State`` holds."""
        return self.packed[..., -2 - 2 * _POSE : -2 - _POSE]

    @property
    def score(self) -> Array:
        """(..., 6) sum of the frames' gradients, each at the estimate of its time."""
        return self.packed[..., -2 - _POSE : -2]

    @property
    def frames(self) -> Array:
        """(...) how many."""
        return self.packed[..., -2]

    @property
    def matches(self) -> Array:
        """(...) how many."""
        return self.packed[..., -1]

    def _matrix(self, place: int) -> Array:
        rows = slice(place * _SQUARE, (place + 1) * _SQUARE)
        return self.packed[..., rows].reshape(*self.packed.shape[:-1], _POSE, _POSE)

    @property
    def scatter_about_mean(self) -> Array:
        """(..., 6, 6) of the frames' gradients."""
        whole = np.maximum(self.frames, 1.0)[..., None, None]
        outer = self.score[..., :, None] * self.score[..., None, :]
        return np.asarray(self.scatter - outer / whole)

    @staticmethod
    def stack(parts: Sequence[Sums]) -> Sums:
        """The sums along a new first axis."""
        return Sums(np.array([part.packed for part in parts]))

    def copy(self) -> Sums:
        """The same, to be filled in."""
        return Sums(self.packed.copy())

    def change(self, **values: Array) -> Sums:
        """The sums with other values of some properties."""
        found = self.copy()
        for name, value in values.items():
            getattr(found, name)[...] = value
        return found

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.packed + other.packed)

    def __mul__(self, weight: Array) -> Sums:
        """All of them times (...) weights."""
        return Sums(self.packed * np.asarray(weight)[..., None])

    def __getitem__(self, index: Any) -> Sums:
        """A part of the leading axes."""
        return Sums(self.packed[index])

    def replace_at(self, index: Any, item: Sums) -> Sums:
        """The sums with a part of the leading axes replaced."""
        found = self.copy()
        found.packed[index] = item.packed
        return found

    def total(self) -> Sums:
        """The sum over the first axis."""
        return Sums(self.packed.sum(axis=0))

    def shift_reference(self, steps: Array) -> Sums:
        """The sums about references that are moved by (..., 6) tangent steps."""
        moved = (self.hessian @ steps[..., None])[..., 0]
        return self.change(gradient=self.gradient + moved)

    def after_walk(self, variance: Array, overconfidence: Array | float) -> tuple[Sums, Array]:
        """The sums after a random walk, and (...) which share of them is left.

        A Hessian that is no covariance's inverse, as of frames far from the estimate, is replaced
        by the one by weights: the gain of a negative eigenvalue has a pole.

        Args:
            variance: (..., 6) of the walk.
            overconfidence: (...) k of the module's description.
        """
        by, hessian = variance / np.asarray(overconfidence)[..., None], self.hessian
        values = np.linalg.eigvalsh(hessian)
        bad = (values[..., 0] < -_LEAST_EIGENVALUE * values[..., -1]) & variance.any(axis=-1)
        hessian = np.where(bad[..., None, None], self.reweighted, hessian)
        gain = np.linalg.inv(np.eye(_POSE) + hessian * by[..., None, :])
        hessian, back = gain @ hessian, gain.swapaxes(-1, -2)
        hessian = (hessian + hessian.swapaxes(-1, -2)) / 2
        kept = np.trace(gain, axis1=-2, axis2=-1) / _POSE
        walked = (self * kept).change(
            hessian=hessian,
            gradient=(gain @ self.gradient[..., None])[..., 0],
            scatter=gain @ self.scatter @ back + hessian * variance[..., None, :] @ hessian,
        )
        return walked, kept

    @property
    def are_determined(self) -> NDArray[np.bool_]:
        """(...) whether all directions of the pose are."""
        hessians = self.hessian
        values = smallest_scaled_eigenvalues(hessians.reshape(-1, _POSE, _POSE))
        return (values > _LEAST_EIGENVALUE).reshape(hessians.shape[:-2])

    def step(self, camera: int) -> Array | None:
        """(6,) from a camera's reference to the minimum of its sums; None if undetermined."""
        if not is_determined(self.hessian[camera]):
            return None
        return np.linalg.solve(self.hessian[camera], -self.gradient[camera])


def is_determined(hessian: Array) -> bool:
    """Whether all six directions are determined."""
    return smallest_scaled_eigenvalue(hessian) > _LEAST_EIGENVALUE


def step_between(one: gtsam.Pose3, two: gtsam.Pose3) -> Array:
    """(6,) tangent step from one T_lidar_camera to another."""
    return np.asarray(one.localCoordinates(two))


def equation_5(
    priors: gtsam.NonlinearFactorGraph, references: Sequence[gtsam.Pose3], sums: Sums
) -> gtsam.NonlinearFactorGraph:
    """Eq. 5 of the paper: priors, and (n,) sums of all matches as a quadratic per camera."""
    graph, at = join(priors), gtsam.Values()
    for camera, reference in enumerate(references):
        own, key = sums[camera], camera_key(camera)
        if own.hessian.any():
            at.insert(key, reference)
            hessian = convex_hessian(own.hessian, own.reweighted)
            factor = gtsam.HessianFactor(key, hessian, -own.gradient, 0.0)
            graph.add(gtsam.LinearContainerFactor(factor, at))
    return graph


def minimum(
    graph: gtsam.NonlinearFactorGraph, start: Sequence[gtsam.Pose3]
) -> tuple[gtsam.Pose3, ...]:
    """T_lidar_camera of all cameras at the minimum of :func:`equation_5`, by Gauss-Newton."""
    values, keys = gtsam.Values(), range(len(start))
    for camera in keys:
        values.insert(camera_key(camera), start[camera])
    for _ in range(_STEPS):
        values = values.retract(graph.linearize(values).optimize())
    return tuple(values.atPose3(camera_key(camera)) for camera in keys)


def sums_of_matches(
    block: CameraBlock, scale: ResidualScale, T_lidar_camera: gtsam.Pose3, reference: gtsam.Pose3
) -> Sums:
    """Hessian by their weights, and gradient at a reference, of matches in and out of the gate."""
    here = block.with_scale(scale).sums(T_lidar_camera)
    sums = Sums.zeros().change(hessian=here.hessian, gradient=here.gradient)
    return sums.shift_reference(step_between(T_lidar_camera, reference))
