"""The posterior of a pose by the images' evidence, sampled: how far it could be from the result.

The error bar of a solution is that of its matches, which were made near one pose. Where the images
tell poses a degree apart as little as chance does, matches agree all the same, and are wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.likelihood import FAR, log_likelihood
from calibgraph.model.geometry import pose_rows
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import core_pool
from calibgraph.trust.frame_scores import FrameScorer
from calibgraph.trust.tempering import sample_posterior
from factors import pose_sigmas

Array = NDArray[np.float64]

MAX_FRAMES = 10  # evenly spread over the dataset: bounds the time
SAMPLES = 1000
REACH = pose_sigmas(rotation_rad=np.radians(1.0), translation_m=0.25)
"""(6,) standard deviations of the prior: how far off the rounds may end."""


def measure_posteriors(dataset: Dataset, rig: Rig, *, seed: int = 0) -> dict[str, Array]:
    """Per camera, (6, 6) second moments of the posterior about a result.

    Args:
        dataset: images and clouds.
        rig: the result.
        seed: of the samples.
    """
    with core_pool() as cores, ThreadPoolExecutor(len(rig.cameras)) as pool:
        scorer = FrameScorer(dataset, spread_out(dataset.frames, MAX_FRAMES), cores)

        def measure(name: str, camera: Camera) -> Array:
            scores = scorer.score_together(scorer.load_images(name, camera), camera, FAR)
            likelihood = log_likelihood(scores)
            twists = sample_posterior(likelihood, REACH, samples=SAMPLES, seed=seed)
            return np.asarray(twists.T @ twists / SAMPLES)

        moments = pool.map(measure, rig.cameras, rig.cameras.values())
        return dict(zip(rig.cameras, moments, strict=True))


def widen(joint: Array, posteriors: Mapping[int, Array]) -> Array:
    """A covariance that is at least that of the posteriors, in every direction of each camera.

    Cameras stay correlated as they are: of a pair that the images tie to each other, the relative
    pose stays known where both are widened alike.

    Args:
        joint: (6 N, 6 N) of all cameras.
        posteriors: per number of a camera, (6, 6) second moments.
    """
    factor = np.eye(len(joint))
    for camera, moments in posteriors.items():
        rows = pose_rows(camera)
        factor[rows, rows] = _factor(joint[rows, rows], moments)
    return np.asarray(factor @ joint @ factor.T)


def _factor(covariance: Array, moments: Array) -> Array:
    """(6, 6) F, so that F C F^T is C where C is wider than the moments, else these."""
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(inverse @ moments @ inverse.T)
    stretch = axes * np.sqrt(np.maximum(ratios, 1.0)) @ axes.T
    return np.asarray(root @ stretch @ inverse)
