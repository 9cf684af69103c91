"""The error bar of matches beside the posteriors by the images: the wider one is reported."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import pose_rows
from calibgraph.model.rig import RelativePose
from calibgraph.model.verdict import Check
from calibgraph.trust.pose_posterior import PosePosterior, widen
from calibgraph.trust.probability import probability_beyond
from calibgraph.trust.thresholds import threshold
from factors import pose_sigmas

MeasurePosteriors = Callable[
    [Mapping[str, Array], Sequence[Sequence[str]]], Mapping[str, PosePosterior]
]
"""The posteriors by the images, of the (6, 6) covariances by the matches and of groups of cameras
that move together."""


@dataclass(frozen=True, eq=False)
class ImagePosteriors:
    """The posteriors of a result's cameras, from a batch or while driving.

    Attributes:
        cameras: all of them, in the order of the covariance.
        by_matches: (6 N, 6 N) covariance.
        posteriors: of those whose images were scored.
    """

    cameras: Sequence[str]
    by_matches: Array
    posteriors: Mapping[str, PosePosterior] = field(default_factory=dict)

    def widen(self, joint: Array) -> Array:
        """(6 N, 6 N): a covariance, widened where the images' evidence is flat."""
        found = self.posteriors.items()
        return widen(joint, {self.cameras.index(name): of.moments for name, of in found})

    def probability_beyond(self, camera: str, tolerance: tuple[float, float]) -> float:
        """The probability that a camera's error is beyond a tolerance [deg, cm]."""
        rows = pose_rows(self.cameras.index(camera))
        own = self.by_matches[rows, rows]
        if camera not in self.posteriors:
            return probability_beyond(own, tolerance)
        return self.posteriors[camera].probability_beyond(own, tolerance)

    def check_flatness(self) -> dict[str, Check]:
        """Per camera with a posterior, whether the images leave its pose more open."""
        if not self.posteriors:
            return {}
        wide, narrow = np.diag(self.widen(self.by_matches)), np.diag(self.by_matches)
        ratios = np.sqrt(wide / narrow).reshape(-1, 6).max(axis=1)
        row, of_cameras = threshold("flat_evidence"), zip(self.cameras, ratios, strict=True)
        return {name: row.check(ratio) for name, ratio in of_cameras if name in self.posteriors}


def measured_pairs(
    poses: Sequence[RelativePose], wrong: Collection[tuple[str, str]] = ()
) -> Iterator[tuple[str, str, Array]]:
    """Relative poses of a rig with their (6, 6) covariances, but for those that are wrong."""
    for pose in poses:
        if (pose.a, pose.b) not in wrong:
            sigmas = pose_sigmas(
                rotation_rad=pose.rotation_sigma_rad, translation_m=pose.translation_sigma_m
            )
            yield pose.a, pose.b, np.diag(sigmas**2)
