"""What the matches of one place share, by the scatter of its frames.

What matches of one frame share is not stated by any matcher but shows in the scatter between
frames. Within a place it is summed up as K, the covariance of a camera's pose by all its frames in
units of that of independent matches: with H = L L^T the Hessian of independent matches,
K = L^T (H_t^-1 G H_t^-1) L, where G is the scatter of the frames' gradients about their place's
mean, with an allowance for few frames, and H_t the true Hessian. The matches of a place stay
independent, with the least variance k of K, at most 1; what their covariance lacks, K - k, belongs
to the pose a_cp, together with what the frames of a place share by the matcher's statement
(``place_variance``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import BlockByPlace, PairByPlace, place_of
from calibgraph.model.findings import error_components
from calibgraph.solver.covariance import FittedObjective, convex_hessian, with_pseudo_frames
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.pairs import PairTerm, usual_excess
from calibgraph.solver.robust import ResidualScale
from factors import pose_sigmas

_LEAST_VARIANCE, _LEAST_EXCESS = 0.1, 1e-3  # of independent matches; of what these are left with
_ROUNDING = 1e-7  # rad and m: a pose that is shared more exactly makes the graph lose digits
WEAK = np.diag(pose_sigmas(rotation_rad=1.0, translation_m=10.0) ** -2.0)
"""Information of a pose within sight, so that few matches have an inverse."""


@dataclass(frozen=True, eq=False)
class WithinPlace:
    """What a camera's matches of one place share, in units of independent matches.

    Attributes:
        least: k of the module's text.
        excess: (6, 6) K - k, positive definite.
        efficiency: of independent matches: their true variance over that of H, in the mean.
        roots: (P, 6, 6) Cholesky roots of the Hessian of each place.
        frames: (P,) of each place.
        alike: frames of a place, in the mean over frames.
    """

    least: float
    excess: Array
    efficiency: float
    roots: Array
    frames: Array
    alike: float

    def mean_variance(self, place_variance: float) -> float:
        """Of all matches of the camera, in units of independent ones, in the mean over a pose."""
        within = self.least + float(np.trace(self.excess)) / 6
        return within + place_variance * self.efficiency * self.alike

    def at_place(self, place_variance: float) -> Array:
        """(P, 6, 6) covariance of a_cp about m_c."""
        shared = place_variance * self.efficiency * self.frames[:, None, None] * np.eye(6)
        inverse = np.linalg.inv(self.roots)
        covariance: Array = inverse.transpose(0, 2, 1) @ (self.excess + shared) @ inverse
        return (covariance + covariance.transpose(0, 2, 1)) / 2 + _ROUNDING**2 * np.eye(6)


def split_excess(covariance: Array) -> tuple[float, Array]:
    """Least variance k, and excess K - k, of the (6, 6) covariance K by all frames."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    least = min(max(float(values[0]), _LEAST_VARIANCE), 1.0)
    return least, (vectors * np.maximum(values - least, _LEAST_EXCESS * least)) @ vectors.T


def within_place(at: FittedObjective, name: str, placed: BlockByPlace) -> WithinPlace:
    """What a camera's matches share.

    Args:
        at: the minimum for independent matches.
        name: of the camera.
        placed: its matches.
    """
    block = at.objective.blocks[name]
    hessians = np.zeros((len(placed.frames), 6, 6))
    np.add.at(hessians, placed.place_of_frame, at.frame_sums[name].hessian)
    root = np.linalg.cholesky(hessians.sum(axis=0) + WEAK)
    robust = at.robust_hessians[name]
    true = convex_hessian(robust + at.objective.gate_hessian.get(name, 0.0), robust) + WEAK
    scatter = frame_scatter(block, at.frame_sums[name].gradient, placed, true)
    frames = placed.frames.astype(np.float64)
    covariance, efficiency = relative_covariance(scatter, root, true)
    return WithinPlace(
        *split_excess(covariance),
        efficiency,
        roots=np.asarray(np.linalg.cholesky(hessians + WEAK)),
        frames=frames,
        alike=float(np.square(frames).sum() / max(frames.sum(), 1)),
    )


def frame_scatter(block: CameraBlock, gradients: Array, placed: BlockByPlace, true: Array) -> Array:
    """(6, 6) covariance of the sum of all frames' gradients, about the means of their places.

    Args:
        block: of one camera.
        gradients: (f, 6) of its frames.
        placed: the same matches, with the place of each frame.
        true: (6, 6) Hessian.
    """
    place, counts = placed.place_of_frame, placed.count_of_frame
    total = np.zeros((len(placed.frames), 6))
    np.add.at(total, place, gradients)
    share = counts / np.bincount(place, counts, len(placed.frames))[place]
    apart = gradients - share[:, None] * total[place]
    free = len(gradients) - len(np.unique(place))
    return allow_for_few_frames(
        apart.T @ apart, true, free, frames=len(gradients), matches=len(block)
    )


def allow_for_few_frames(
    scatter: Array, true: Array, free: float, *, frames: float, matches: float
) -> Array:
    """(6, 6) covariance of the sum of all frames' gradients, by their scatter.

    Args:
        scatter: (6, 6) sum of the outer products about the means of places.
        true: (6, 6) Hessian.
        free: frames that the means leave.
        frames: all of them.
        matches: in them.
    """
    usual = 1.0 + error_components().frame_correlation * (matches / frames - 1.0)
    count = free + 1.0  # as many frames of one place
    usual_scatter = usual * true * count / frames
    whole = with_pseudo_frames(scatter, true, count, usual_scatter)
    return whole * frames / count


def relative_covariance(scatter: Array, root: Array, true: Array) -> tuple[Array, float]:
    """(6, 6) K of the module's text; the true variance of independent matches over that of H.

    Args:
        scatter: (6, 6) covariance of the gradients' sum.
        root: (6, 6) L.
        true: (6, 6) H_t.
    """
    inverse = np.linalg.inv(true)
    covariance: Array = root.T @ inverse @ scatter @ inverse @ root
    return covariance, float(np.trace(root.T @ inverse @ root)) / 6


Numbers = NDArray[np.int64]


def block_by_place(
    camera: CameraBlock, scale: ResidualScale, places: Sequence[Numbers]
) -> BlockByPlace:
    """The correspondences of a camera, sorted by place.

    Args:
        camera: its correspondences.
        scale: of their residuals.
        places: the frame numbers of each place.
    """
    of_frame, counts = place_of(camera.frame_numbers, places), camera.frame_counts
    if len(places) == 1:
        return BlockByPlace(camera.with_scale(scale), np.array([0, len(camera)]), of_frame, counts)
    edges = np.zeros(len(places) + 1, dtype=np.int64)
    np.add.at(edges[1:], of_frame, counts)
    block = camera.sorted_by(of_frame).with_scale(scale)
    return BlockByPlace(block, edges.cumsum(), of_frame, counts)


def pairs_by_place(
    pairs: Sequence[PairTerm], places: Sequence[Numbers], cameras: Sequence[str]
) -> list[PairByPlace]:
    """Each term with the information of features that err as usual in a frame."""
    found = []
    for pair in pairs:
        own = [one for one in pairs if {one.a, one.b} == {pair.a, pair.b}]
        of_row = place_of(pair.frame, places)
        rows = np.argsort(of_row, kind="stable")
        present, first = np.unique(of_row[rows], return_index=True)
        edges = np.append(first, len(rows))
        block = pair.block.with_variance(usual_excess(own)).select(rows)
        numbers = cameras.index(pair.a), cameras.index(pair.b)
        found.append(PairByPlace(numbers, block, present, edges))
    return found
