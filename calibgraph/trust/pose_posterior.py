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

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import gtsam
import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer
from scipy.optimize import brentq
from scipy.special import expit, logsumexp

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.matching.structure.consensus import FAR, log_likelihood
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of
from calibgraph.matching.structure.schedule import Level
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    score_frame,
)
from calibgraph.model.geometry import pose_rows, relative_transform, twist_between
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import Threads, core_pool
from calibgraph.trust.probability import probability_beyond
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


MAX_WINDOWS, SHARING_FRAMES = 10_000, 10
"""Per camera over that many frames; with more frames, as many each."""


class FrameScorer:
    """Scores frames in parallel; images and clouds are decoded once."""

    def __init__(self, dataset: Dataset, frames: Sequence[Frame], pool: ThreadPoolExecutor) -> None:
        self.frames = frames
        self.dataset = dataset
        self._pool = pool
        self._cache = cache_of(frames, FrameCache())

    def score(
        self, name: str, camera: Camera, level: Level, *, offset: int = 0
    ) -> list[ShiftScores | None]:
        """Score a camera's images against the clouds ``offset`` frames later, None without one."""
        most = MAX_WINDOWS // min(len(self.frames), SHARING_FRAMES)

        def score(frame: Frame) -> ShiftScores | None:
            other = self.dataset.neighbour(frame, offset) if offset else frame
            return None if other is None else score_frame(
                self._cache.image(frame, name, camera), self._cache.cloud(other), camera, level,
                frame=frame.index, max_windows=most, twist_per_s=other.twist_per_s,
            )  # fmt: skip

        return list(self._pool.map(score, self.frames))

    def score_together(self, name: str, camera: Camera, level: Level) -> ShiftScores:
        """Score all images against their own clouds."""
        scores = self.score(name, camera, level)
        return concatenate_scores([each for each in scores if each is not None])


def _read_samples(value: Any) -> Any:
    """(n, 6) from base64 of half precision, a tenth of the digits' size."""
    if not isinstance(value, str):
        raise ValueError("expected base64")
    samples = np.frombuffer(base64.b64decode(value, validate=True), "<f2")
    if not len(samples) or len(samples) % 6 or not np.isfinite(samples).all():
        raise ValueError("expected base64 of finite (n, 6) half-precision numbers")
    return samples.reshape(-1, 6).astype(np.float64)


def _write_samples(samples: Array) -> str:
    return base64.b64encode(samples.astype("<f2").tobytes()).decode()


_Samples = Annotated[Array, BeforeValidator(_read_samples), PlainSerializer(_write_samples)]


@dataclass(frozen=True, eq=False)
class PosePosterior:
    """The posterior of a camera's pose about a result, as twists from it; a file has its samples.

    Attributes:
        near: (n, 6) samples, if the rounds ended where the matches say.
        elsewhere: (n, 6) samples, if they ended elsewhere; the densest first.
        share: the probability that they ended elsewhere.
        log_ratio: twice the logarithm of the highest density elsewhere over that at a pose in
            question; infinite if there is none.
    """

    near: _Samples
    elsewhere: _Samples
    share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
    log_ratio: Annotated[float, Field(exclude=True)] = np.inf

    def from_another(self, away: Array) -> PosePosterior:
        """The same posterior about a pose from which that of the samples is a (6,) twist away."""
        return replace(self, near=self.near + away, elsewhere=self.elsewhere + away)

    @property
    def moments(self) -> Array:
        """(6, 6) second moments of both together."""
        return (1.0 - self.share) * _moments(self.near) + self.share * _moments(self.elsewhere)

    def widest(self, covariance: Array) -> Array:
        """(6, 6): a covariance that is at least that of the poses elsewhere."""
        return widen(covariance, {0: _moments(self.elsewhere)})

    def probability_beyond(self, by_matches: Array, tolerance: tuple[float, float]) -> float:
        """The probability of an error beyond the tolerance [deg, cm].

        Near the result the error is at least as wide as the (6, 6) covariance by the matches.
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

        def measure(group: Sequence[str]) -> dict[str, PosePosterior]:
            T, terms = rig.T_camera_lidar, []
            for name in group:
                camera = rig.cameras[name]
                scores = scorer.score_together(name, camera, FAR)
                Ad = gtsam.Pose3(relative_transform(T[name], T[group[0]])).AdjointMap()
                terms.append((log_likelihood(scores), Ad))

            def likelihood(twists: Array) -> Array:
                return np.asarray(np.mean([of(twists @ Ad.T) for of, Ad in terms], axis=0))

            near, elsewhere, share = _sample_both(likelihood, covariances[group[0]], seed)
            found = {}
            for name, (_, Ad) in zip(group, terms, strict=True):
                ratio = np.inf
                if asked is not None:
                    of_first = np.linalg.solve(Ad, twist_between(asked[name], T[name]))
                    twists = np.vstack([of_first, elsewhere])
                    density = likelihood(twists) - 0.5 * ((twists / REACH) ** 2).sum(axis=1)
                    ratio = float(2.0 * (density.max() - density[0]))
                found[name] = PosePosterior(near @ Ad.T, elsewhere @ Ad.T, share, ratio)
            return found

        return {name: each for of in pool.map(measure, groups) for name, each in of.items()}


def _sample_both(
    likelihood: Callable[[Array], Array], by_matches: Array, seed: int
) -> tuple[Array, Array, float]:
    """(n, 6) samples near the result and elsewhere; by their evidence, the share of the latter."""
    sample = partial(sample_posterior, likelihood, samples=SAMPLES, seed=seed)
    with core_pool() as pool:
        priors = NEAR**2 * by_matches, np.diag(REACH**2)
        (near, of_near), (far, of_far) = pool.map(sample, priors)
    return near, far, float(expit(np.log(ODDS_ELSEWHERE) + of_far - of_near))


def group_tied(
    cameras: Sequence[str], known: Iterable[tuple[str, str, Array]]
) -> list[tuple[str, ...]]:
    """The cameras in groups that can only be elsewhere together.

    Two are tied by the (6, 6) covariance of their relative pose, known without the cloud, if it is
    below ``TIED`` of ``REACH`` along every axis.
    """
    groups = {name: {name} for name in cameras}
    for a, b, covariance in known:
        if {a, b} <= groups.keys() and (np.sqrt(np.diag(covariance)) < TIED * REACH).all():
            joined = groups[a] | groups[b]
            groups |= dict.fromkeys(joined, joined)
    named = (tuple(name for name in cameras if name in groups[one]) for one in cameras)
    return [*dict.fromkeys(named)]


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


_EFFECTIVE = 0.8  # share of the samples that each step keeps
_MOVES = 3  # of every sample, after each step
_STEP = 2.38  # over the square root of the dimension: the best width of a Metropolis move
_NARROW = 0.3  # every other move is so much of that, for modes narrower than all samples together


def sample_posterior(
    likelihood: Callable[[Array], Array], prior: Array, *, samples: int, seed: int
) -> tuple[Array, float]:
    """Draw (n, k) samples of prior times likelihood; with the log of the integral, the evidence.

    Sequential Monte Carlo: the likelihood enters with an exponent that grows from 0 to 1, in steps
    that keep most samples effective. After each, samples are drawn again by their weights, and
    moved by Metropolis steps as wide as they are. With 1000 samples a standard deviation repeats to
    a tenth. The densest sample comes first.

    Args:
        likelihood: (n,) its logarithms at (n, k) points.
        prior: (k, k) covariance of the prior, a Gaussian about 0.
        samples: their number n.
        seed: of the draws.
    """
    rng, root = np.random.default_rng(seed), np.linalg.cholesky(prior)
    points = rng.standard_normal((samples, len(prior)))  # in standard deviations of the prior
    values, exponent, evidence = likelihood(points @ root.T), 0.0, 0.0
    while exponent < 1.0:
        step = _next_step(values, 1.0 - exponent)
        exponent += step
        evidence += float(logsumexp(step * values)) - np.log(samples)
        drawn = rng.choice(samples, samples, p=_weights(values, step))
        points, values = points[drawn], values[drawn]
        for _ in range(_MOVES):
            proposed = points + _draw_moves(points, rng)
            found = likelihood(proposed @ root.T)
            odds = exponent * (found - values) + _log_prior(proposed) - _log_prior(points)
            accepted = np.log(rng.random(samples)) < odds
            points[accepted], values[accepted] = proposed[accepted], found[accepted]
    densest_first = np.argsort(-(values + _log_prior(points)), kind="stable")
    return points[densest_first] @ root.T, evidence


def _next_step(values: Array, left: float) -> float:
    """By how much the exponent can grow, at most by what is left."""

    def excess(step: float) -> float:
        weights = _weights(values, step)
        return float(1.0 / (weights**2).sum()) - _EFFECTIVE * len(values)

    return left if excess(left) >= 0 else float(brentq(excess, 0.0, left, rtol=1e-3))


def _weights(values: Array, step: float) -> Array:
    weights = np.exp(step * (values - values.max()))
    return np.asarray(weights / weights.sum())


def _draw_moves(points: Array, rng: np.random.Generator) -> Array:
    count, size = points.shape
    covariance = np.cov(points.T) + 1e-12 * np.eye(size)
    widths = _STEP / np.sqrt(size) * rng.choice([1.0, _NARROW], (count, 1))
    return np.asarray(widths * rng.multivariate_normal(np.zeros(size), covariance, count))


def _log_prior(whitened: Array) -> Array:
    return np.asarray(-0.5 * (whitened**2).sum(axis=1))
