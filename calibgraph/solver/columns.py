"""Scan distortion, lens and clock of a camera beside its pose, as columns of one quadratic.

Near an optimum half the cost of a camera's matches is a quadratic in its pose x and in columns, of
which some are estimated (e), some are considered (c), and the others are fixed. With a = (x, e),

    H = [ H_aa  H_ac ]     a = -H_aa^-1 g_a,     follow = H_aa^-1 H_ac,
        [ H_ca  H_cc ]

    covariance of a = H_aa^-1 S H_aa^-1 + shared H_aa^-1 + follow follow^T

where S is the scatter of the gradients of frames, and ``shared`` the variance of what all frames
share, which their scatter does not show. What is considered is zero give or take one standard
deviation, which is its unit: it is not estimated, and widens what is.

The scan distortion displaces a camera's matches. The part that no pose can follow remains in the
residuals and measures it: informative for a panoramic camera, weak for a narrow one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import place_of
from calibgraph.graph.lens import LensVariable
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import adjoints, transform
from calibgraph.model.rig import Camera
from calibgraph.solver.covariance import convex_hessian, with_pseudo_frames
from calibgraph.solver.matches import CameraBlock, camera_block
from calibgraph.solver.robust import ResidualScale, quantile
from calibgraph.solver.within_place import WEAK
from factors import Columns, ProjectionBlock, to_runs
from factors.columns import DISTORTION

Numbers = NDArray[np.int64]

MIN_ROWS = 30  # fewer correspondences do not determine further columns
_MAX_ITERATIONS, _NEAR, _SMALL, _CONVERGED = 20, 0.1, 0.02, 3e-4
"""Steps of the fit; the change of the errors (rms), in units of the loss' scale, from which on they
are Newton's, after which nothing is summed again, and at which they end."""
_NEARLY_FREE = 1e-4  # information of a column, so that a few matches have an inverse
_LOSS_MEDIANS = 2.0 * 1.4826  # loss scale of 2 standard deviations, by the median of the errors
_SAMPLE = 4000  # correspondences: they know the displacement to some 1 % of its size


@dataclass(frozen=True, eq=False)
class Marginal:
    """Some of the columns, fitted with the pose.

    Attributes:
        twist: (6,) of the pose: T_camera_lidar = exp(twist) estimate [rad, m].
        values: (m,) of the columns.
        covariance: (m, m) of these, by the scatter of the frames and what they share; NaN with one
            frame.
        compensating: (6, m) twists by which the pose makes up for a unit of each.
    """

    twist: Array
    values: Array
    covariance: Array
    compensating: Array

    @property
    def sigmas(self) -> Array:
        """(m,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class ColumnFit:
    """The minimum with all columns free, and what the fits of fewer are made of.

    Attributes:
        values: (6 + k,) of the pose, in the tangent of T_lidar_camera, and of the columns.
        hessian: (6 + k, 6 + k), by the weights at the minimum.
        gradients: (f, 6 + k) of the frames, there.
        shared: variance of what all frames share, over that of independent matches.
        considered: so many of the last columns are considered, and never estimated.
    """

    values: Array
    hessian: Array
    gradients: Array
    shared: float
    considered: int = 0

    def counted_from(self, start: Array) -> ColumnFit:
        """The same fit; the first columns were linearized at (k,) values."""
        rest = len(self.values) - 6 - len(start)
        return replace(self, values=self.values + np.pad(start, (6, rest)))

    def free(self, *columns: int) -> Marginal:
        """The fit of the pose and some columns, with their numbers; the others are zero."""
        return self.free_each([columns])[0]

    def free_each(self, choices: Sequence[Sequence[int]]) -> list[Marginal]:
        """The fits of several choices of as many columns: each as :meth:`free`."""
        rows = np.array([[*range(6), *(6 + number for number in each)] for each in choices])
        own, size = self.hessian[rows[:, :, None], rows[:, None]], rows.shape[1]
        diagonal = np.sqrt(np.maximum(np.einsum("fii->fi", own), 0.0))
        units = np.where(diagonal > 0, diagonal, 1.0)
        units = units[:, :, None] * units[:, None]
        inverse = np.linalg.inv(own / units) / units
        values = (inverse @ (self.hessian @ self.values)[rows, None])[:, :, 0]
        frames, pulls = len(self.gradients), self.gradients.T[rows]
        shown = pulls @ pulls.transpose(0, 2, 1)
        scatter = with_pseudo_frames(shown, own, float(frames))
        scatter += _nearly_free(size) if frames > 1 else np.nan
        follow = inverse @ self.hessian[rows, len(self.hessian) - self.considered :]
        whole = inverse @ scatter @ inverse + self.shared * inverse
        whole = (whole + follow @ follow.transpose(0, 2, 1))[:, 6:, 6:]
        given_in = np.linalg.solve(own[:, :6, :6], own[:, :6, 6:])
        # Of T_camera_lidar the twist is minus that of T_lidar_camera.
        each = zip(-values[:, :6], values[:, 6:], whole, given_in, strict=True)
        return [Marginal(*parts) for parts in each]


def fit_columns(
    block: CameraBlock,
    T_camera_lidar: Array,
    free: Columns,
    *,
    loss_scale: float | None = None,
    shared_variance: float = 0.0,
    considered: int = 0,
) -> ColumnFit | None:
    """Fit pose and columns, linearized once, with a Cauchy loss on the norm of each match's error.

    Args:
        block: the matches of a camera.
        T_camera_lidar: (4, 4) about which is linearized.
        free: the columns, and the lens about which is linearized.
        loss_scale: of the whitened errors; None: from their median, which holds for up to about a
            third of outliers.
        shared_variance: of what all frames share, over that of all matches if these were
            independent.
        considered: see :class:`ColumnFit`.

    Returns:
        The fit, or None of fewer than ``MIN_ROWS`` matches, or where it has no derivative.
    """
    if len(block) < MIN_ROWS:
        return None
    size, runs = 6 + len(free), to_runs(block.frame_edges)
    weak, values = _nearly_free(size), np.zeros(size)
    near = loss_scale is not None  # elsewhere the second derivative may lead away
    for _ in range(_MAX_ITERATIONS):
        scale = loss_scale or _median_scale(block.block, T_camera_lidar, free, values)
        sums = block.block.rescale(scale=scale).summarize(
            T_camera_lidar[None], runs, free, step=values, curvature=near
        )
        hessian = used = sums.hessian.sum(axis=0) + weak
        if sums.curvature is not None:
            used = convex_hessian(sums.curvature.sum(axis=0) + weak, hessian)
        change = -np.linalg.solve(used, sums.gradient.sum(axis=0) + weak @ values)
        values = values + change
        moved = float(change @ hessian @ change) / (scale**2 * _given(sums.weights).sum())
        gradients = sums.gradient
        if loss_scale and sums.curvature is not None and moved < _SMALL**2:
            gradients = gradients + sums.curvature @ change  # to first order
            break
        if not moved > _CONVERGED**2:
            break
        near = moved < _NEAR**2
    if not np.isfinite(values).all():  # points where no derivative exists
        return None
    squares, weights = (_given(part).sum() for part in (sums.squares, sums.weights))
    variance = shared_variance * float(squares / (2 * weights))
    return ColumnFit(values, hessian, gradients, variance, considered)


def _given(part: Array | None) -> Array:
    assert part is not None
    return part


def _median_scale(
    block: ProjectionBlock, T_camera_lidar: Array, free: Columns, values: Array
) -> float:
    """A scale of the loss by the median of the errors after a step."""
    columns = block.columns(T_camera_lidar, free)
    errors = columns[-1] + np.tensordot(values, columns[:-1], axes=1)
    return _LOSS_MEDIANS * math.sqrt(quantile(np.square(errors).sum(axis=0), 0.5)) + 1e-12


@cache
def _nearly_free(size: int) -> Array:
    """(6 + k, 6 + k) information of a pose within sight and of columns that are nearly free."""
    return np.diag(np.append(np.diag(WEAK), np.full(size - 6, _NEARLY_FREE)))


def block_of(camera: Camera, table: Correspondences) -> CameraBlock:
    """The rows of one camera, by frame, whitened by their information alone.

    If the motion of the LiDAR is known, points are where they are when they are seen.
    """
    in_order = table.select(np.argsort(table.frame, kind="stable"))
    return camera_block(camera, in_order, Config())


def apply_twist(camera: Camera, twist: Array) -> Camera:
    """The camera at exp(twist) T_camera_lidar, to first order in the translation.

    Args:
        camera: at its estimate.
        twist: (6,) rotation [rad] and translation [m], in the camera's axes.
    """
    step = transform(Rotation.from_rotvec(twist[:3]), twist[3:])
    return camera.moved_to(np.asarray(step @ camera.T_camera_lidar))


@dataclass(frozen=True, eq=False)
class DistortionEvidence:
    """Quadratics of a camera's matches in the distortions.

    Near the minimum half the squared residuals are those of a pose that has moved by ``jacobian``
    times the distortions, plus the quadratics of ``information`` and ``vector``.

    Attributes:
        jacobian: (6, 3) displacement of their pose by a unit of each distortion.
        hessian: (6, 6) J^T J of all matches plus the weak prior: the weight of ``jacobian`` in a
            mean over several sets of matches.
        information: (3, 3) of the residuals, if all matches were independent.
        vector: (3,) the information times the distortions that the residuals show.
        lens_jacobian: (k, 3) displacement of a free lens, likewise; of a fixed one, (0, 3).
    """

    jacobian: Array
    hessian: Array
    information: Array
    vector: Array
    lens_jacobian: Array = field(default_factory=lambda: np.zeros((0, len(DISTORTION))))


def distortion_evidence(
    block: CameraBlock,
    scale: ResidualScale,
    T_camera_lidar: Array,
    weak: Array,
    *,
    places: Sequence[Numbers],
    lens: LensVariable | None = None,
) -> DistortionEvidence:
    """The quadratics of a camera's matches, in the tangent of ``T_lidar_camera``.

    By squares of the residuals, without the loss. At each place the distortion is reduced by what a
    pose of that place can follow, so that a displaced place shows no distortion.

    Args:
        block: inliers of one camera.
        scale: of their residuals.
        T_camera_lidar: (4, 4) their minimum.
        weak: (6 + k, 6 + k) information that is added to the Hessian, so that few matches have an
            inverse.
        places: the numbers of the frames of each place.
        lens: of the camera, if it is free; it follows as the pose does.
    """
    some = block.select_evenly(_SAMPLE)
    share = len(some) / len(block)
    place = place_of(some.frame, places)
    order = np.argsort(place, kind="stable")
    edges = np.searchsorted(place[order], np.arange(len(places) + 1))
    known = Columns(block.block.lens) if lens is None else lens.free
    free = replace(
        known,
        parameters=(*known.parameters, *DISTORTION),
        sigmas=(*known.sigmas, *(1.0 for _ in DISTORTION)),
    )
    values = np.zeros(len(free))
    values[: len(known)] = 0.0 if lens is None else lens.values
    squares = some.block.select(order).rescale(scale=math.inf, sigma=scale.sigma)
    sums = squares.summarize(T_camera_lidar[None], to_runs(edges), free, values)
    size = 6 + len(known)  # of what follows
    moves, bends = slice(size), slice(size, None)
    hessian = np.concatenate([sums.hessian, sums.hessian.sum(axis=0)[None]])
    own, across = hessian[:, moves, moves], hessian[:, moves, bends]
    follow = -np.linalg.solve(own + share * weak, across)
    turned = follow.transpose(0, 2, 1)
    left = hessian[:, bends, bends] + turned @ across
    left = left + (across.transpose(0, 2, 1) + turned @ own) @ follow
    pull = sums.gradient[:, bends] + np.einsum("pij,pi->pj", follow[:-1], sums.gradient[:, moves])
    whole, shown = own[-1] / share + weak, (left[:-1].sum(axis=0) / share, pull.sum(axis=0) / share)
    return DistortionEvidence(follow[-1, :6], whole[:6, :6], *shown, follow[-1, 6:])


def pair_jacobians(
    jacobians: Array,
    seen: NDArray[np.bool_],
    T_lidar_camera: Array,
    pairs: Sequence[tuple[int, int]],
) -> Array:
    """(N, 6, B) displacement of each camera's pairs by a unit of each distortion.

    Images show the relative pose of two cameras whatever the cloud. Their pose to the cloud comes
    from its surfaces, which are distorted as the matches see them. So a pair follows by one motion
    of the cloud, the mean over its cameras, and a camera by the mean over its pairs.

    Args:
        jacobians: (N, 6, B) of the matches of all cameras.
        seen: (N,) which cameras have matches.
        T_lidar_camera: (N, 4, 4).
        pairs: numbers of the cameras of each.
    """
    to_cloud = adjoints(T_lidar_camera)
    of_cloud = to_cloud @ jacobians
    total, count = np.zeros_like(jacobians), np.zeros(len(jacobians))
    for pair in pairs:
        known = [camera for camera in pair if seen[camera]]
        if known:
            total[list(pair)] += of_cloud[known].mean(axis=0)
            count[list(pair)] += 1.0
    mean = total / np.maximum(count, 1.0)[:, None, None]
    return np.asarray(np.linalg.solve(to_cloud, mean))
