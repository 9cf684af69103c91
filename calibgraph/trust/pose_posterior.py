"""The posterior of a pose by the images' evidence, sampled: how far it could be from the result.

The error bar of a solution is that of its matches, which were made near one pose. Where the images
tell poses a degree apart as little as chance does, matches agree all the same, and are wrong. So
either the rounds ended where the matches say, by ``NEAR`` times their error bar, or elsewhere; the
evidence of both, the likelihood's mean over their priors, tells how likely each is.

Cameras whose relative pose images show, or which is measured, can only be elsewhere together: one
motion of the cloud for all of them. Their images show the same surfaces, so the evidence is the
mean, not the sum: with that the truth is as likely under it as by one camera alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from scipy.special import expit

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.consensus import FAR, log_likelihood
from calibgraph.model.geometry import pose_rows, relative_transform, twist_between
from calibgraph.model.rig import Rig
from calibgraph.parallel import Threads, core_pool
from calibgraph.trust.frame_scores import FrameScorer
from calibgraph.trust.probability import probability_beyond
from calibgraph.trust.tempering import sample_posterior
from factors import pose_sigmas

MAX_FRAMES = 10  # evenly spread over the dataset: bounds the time
SAMPLES = 1000
NEAR = 3.0  # the prior of a result that is right, in standard deviations of its matches
ODDS_ELSEWHERE = 20.0
"""Prior odds of rounds that ended elsewhere: with it one result in ten is misled. Fitted on a KITTI
rig, a car with six cameras and a 16-beam LiDAR, with their own clouds and with those of other
frames: 17 to 26 by their weights, without any one of them 19 to 32. The weight of the evidence fits
as 1.3, not 1."""
REACH = pose_sigmas(rotation_rad=np.radians(1.0), translation_m=0.25)
"""(6,) standard deviations of the prior of rounds that ended elsewhere."""
TIED = 0.1
"""Share of ``REACH`` below which a relative pose ties two cameras: they are elsewhere together."""


@dataclass(frozen=True, eq=False)
class PosePosterior:
    """The posterior of a camera's pose about a result, as twists from it.

    Attributes:
        near: (n, 6) samples, if the rounds ended where the matches say.
        elsewhere: (n, 6) samples, if they ended elsewhere; the densest first.
        share: the probability that they ended elsewhere.
        log_ratio: twice the logarithm of the highest density elsewhere over that at a pose in
            question; infinite if there is none.
    """

    near: Array
    elsewhere: Array
    share: float
    log_ratio: float = np.inf

    @property
    def moments(self) -> Array:
        """(6, 6) second moments of both together."""
        near, elsewhere = (_moments(samples) for samples in (self.near, self.elsewhere))
        return (1.0 - self.share) * near + self.share * elsewhere

    def moved(self, adjoint: Array) -> PosePosterior:
        """The same of another camera that moves with this one.

        Args:
            adjoint: (6, 6) from twists of this camera to those of the other.
        """
        return PosePosterior(self.near @ adjoint.T, self.elsewhere @ adjoint.T, self.share)

    def widest(self, covariance: Array) -> Array:
        """(6, 6): a covariance that is at least that of the poses elsewhere."""
        return widen(covariance, {0: _moments(self.elsewhere)})

    def probability_beyond(self, by_matches: Array, tolerance: tuple[float, float]) -> float:
        """The probability of an error beyond the tolerance.

        Args:
            by_matches: (6, 6) covariance; near the result the error is at least as wide.
            tolerance: rotation [deg] and distance [cm].
        """
        widened = widen(by_matches, {0: _moments(self.near)})
        near = max(probability_beyond(widened, tolerance), _share_beyond(self.near, tolerance))
        elsewhere = _share_beyond(self.elsewhere, tolerance)
        return (1.0 - self.share) * near + self.share * elsewhere


def _moments(samples: Array) -> Array:
    return np.asarray(samples.T @ samples / len(samples))


def _share_beyond(samples: Array, tolerance: tuple[float, float]) -> float:
    rotation, distance = np.linalg.norm(samples.reshape(-1, 2, 3), axis=2).T
    off = (rotation > np.radians(tolerance[0])) | (distance > tolerance[1] / 100)
    return float(off.mean())


def measure_posteriors(
    dataset: Dataset,
    rig: Rig,
    covariances: Mapping[str, Array],
    groups: Sequence[Sequence[str]],
    *,
    asked: Mapping[str, Array] | None = None,
    seed: int = 0,
) -> dict[str, PosePosterior]:
    """Per camera of a group, the posterior about a result.

    Args:
        dataset: images and clouds.
        rig: the result.
        covariances: per camera, (6, 6) of the result by its matches.
        groups: cameras that move together, see :func:`group_tied`; they have one evidence.
        asked: per camera, (4, 4) T_camera_lidar in question, for ``log_ratio``.
        seed: of the samples.
    """
    with core_pool() as cores, Threads(max(len(groups), 1)) as pool:
        scorer = FrameScorer(dataset, spread_out(dataset.frames, MAX_FRAMES), cores)

        def likelihood_of(name: str) -> Callable[[Array], Array]:
            camera = rig.cameras[name]
            return log_likelihood(
                scorer.score_together(scorer.load_images(name, camera), camera, FAR)
            )

        def measure(group: Sequence[str]) -> dict[str, PosePosterior]:
            to_first = rig.T_camera_lidar[group[0]]
            adjoints = [
                gtsam.Pose3(relative_transform(rig.T_camera_lidar[name], to_first)).AdjointMap()
                for name in group
            ]
            terms = list(zip([*map(likelihood_of, group)], adjoints, strict=True))

            def likelihood(twists: Array) -> Array:
                found = [of(twists @ moved.T) for of, moved in terms]
                return np.asarray(np.mean(found, axis=0))

            found = _posterior_of(likelihood, covariances[group[0]], seed)
            posteriors = {}
            for name, adjoint in zip(group, adjoints, strict=True):
                of_camera = found.moved(adjoint)
                if asked is not None:
                    away = twist_between(asked[name], rig.T_camera_lidar[name])
                    of_first = np.asarray(np.linalg.solve(adjoint, away), np.float64)
                    ratio = _log_ratio(likelihood, found.elsewhere, of_first)
                    of_camera = replace(of_camera, log_ratio=ratio)
                posteriors[name] = of_camera
            return posteriors

        return {name: each for of in pool.map(measure, groups) for name, each in of.items()}


def _posterior_of(
    likelihood: Callable[[Array], Array], by_matches: Array, seed: int
) -> PosePosterior:
    """Near the result or elsewhere, weighed by the evidence of both."""
    sample = partial(sample_posterior, likelihood, samples=SAMPLES, seed=seed)
    with core_pool() as pool:
        priors = NEAR**2 * by_matches, np.diag(REACH**2)
        (near, of_near), (far, of_far) = pool.map(sample, priors)
    return PosePosterior(near, far, float(expit(np.log(ODDS_ELSEWHERE) + of_far - of_near)))


def _log_ratio(likelihood: Callable[[Array], Array], elsewhere: Array, asked: Array) -> float:
    """Twice the log of the highest density of samples elsewhere over that at a twist (6,)."""
    twists = np.vstack([asked, elsewhere])
    density = likelihood(twists) - 0.5 * ((twists / REACH) ** 2).sum(axis=1)
    return float(2.0 * (density.max() - density[0]))


def group_tied(
    cameras: Sequence[str], known: Iterable[tuple[str, str, Array]]
) -> list[tuple[str, ...]]:
    """The cameras in groups that can only be elsewhere together.

    Args:
        cameras: of the groups; others are left out.
        known: two cameras and the (6, 6) covariance of their relative pose without the cloud. It
            ties them if it is below ``TIED`` of ``REACH`` along every axis.
    """
    groups = {name: {name} for name in cameras}
    for a, b, covariance in known:
        if {a, b} <= groups.keys() and (np.sqrt(np.diag(covariance)) < TIED * REACH).all():
            joined = groups[a] | groups[b]
            groups |= dict.fromkeys(joined, joined)
    named = (tuple(name for name in cameras if name in groups[one]) for one in cameras)
    return [*dict.fromkeys(named)]


def no_posteriors(*_: object) -> dict[str, PosePosterior]:
    """Of no camera: where there are no images."""
    return {}


def widen(joint: Array, moments: Mapping[int, Array]) -> Array:
    """A covariance that is at least that of the posteriors, in every direction of each camera.

    Cameras stay correlated as they are: of a pair that the images tie to each other, the relative
    pose stays known where both are widened alike.

    Args:
        joint: (6 N, 6 N) of all cameras; rows of cameras that are not known may be NaN.
        moments: per number of a camera, (6, 6) second moments.
    """
    widened = joint.copy()
    for camera, own in moments.items():
        rows = pose_rows(camera)
        factor = _factor(joint[rows, rows], own)
        widened[rows] = factor @ widened[rows]
        widened[:, rows] = widened[:, rows] @ factor.T
    return widened


def _factor(covariance: Array, moments: Array) -> Array:
    """(6, 6) F, so that F C F^T is C where C is wider than the moments, else these."""
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(inverse @ moments @ inverse.T)
    stretch = axes * np.sqrt(np.maximum(ratios, 1.0)) @ axes.T
    return np.asarray(root @ stretch @ inverse)
