"""Whether all places agree: each against the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.by_place import place_of
from calibgraph.model.error_components import error_components
from calibgraph.model.threshold import Threshold
from calibgraph.model.verdict import Check
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.error_model import ErrorFit
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import threshold

Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class PlaceAgreement:
    """One place, as one camera sees it, against the others.

    Attributes:
        number: of the place, from 1.
        frames: its frame numbers.
        sigmas: distance of the camera or of the cloud there from where they are elsewhere.
        inliers: share of the matches within the gate, over its median at the other places.
    """

    number: int
    frames: Numbers
    sigmas: float
    inliers: float

    def describe(self) -> str:
        """The place in words."""
        first, last = int(self.frames[0]), int(self.frames[-1])
        which = f"frame {first}" if first == last else f"frames {first} to {last}"
        return f"place {self.number} ({which})"


def place_agreements(evidence: Evidence, errors: ErrorFit, camera: str) -> list[PlaceAgreement]:
    """All places where a camera has correspondences."""
    before, after = evidence.fitted_blocks[camera], evidence.solution.inliers.blocks[camera]
    cameras = tuple(errors.model.cameras)
    distances = errors.fit.linear.distances[:, [0, 1 + cameras.index(camera)]].max(axis=1)
    kept, given = (_count(block, errors.places) for block in (after, before))
    seen = np.flatnonzero(given)
    shares = kept[seen] / given[seen]
    return [
        PlaceAgreement(
            number=int(place) + 1,
            frames=errors.places[place],
            sigmas=float(distances[place]),
            inliers=float(share / max(np.median(np.delete(shares, index)), 1e-9)),
        )
        for index, (place, share) in enumerate(zip(seen, shares, strict=True))
        if len(seen) > 1
    ]


def _count(block: CameraBlock, places: Sequence[Numbers]) -> Array:
    """(P,) correspondences at each place."""
    place = place_of(block.frame_numbers, places)
    return np.asarray(np.bincount(place, block.frame_counts, len(places)), dtype=np.float64)


def place_checks(evidence: Evidence) -> Checks:
    """Whether any place contradicts the others, where there are enough to tell which."""
    errors = evidence.solution.marginals.errors
    if errors is None or len(errors.places) < error_components().robust_places:
        return {}
    found = {name: place_agreements(evidence, errors, name) for name in errors.model.blocks}
    return {name: _check(places) for name, places in found.items() if places}


def _check(places: Sequence[PlaceAgreement]) -> list[Check]:
    """The place that agrees least, by its distance and by its inliers."""
    far = max(places, key=lambda place: place.sigmas)
    few = min(places, key=lambda place: place.inliers)
    return [
        _describe(threshold("place_distance"), far.sigmas, far),
        _describe(threshold("place_inliers"), few.inliers, few),
    ]


def _describe(row: Threshold, value: float, place: PlaceAgreement) -> Check:
    status = row.grade(value)
    number = f"{value:.2g} {row.unit}".rstrip()
    advice = "" if status == "PASS" else f": {row.advice}"
    return row.describe(value, status, f"{row.name}: {number} at {place.describe()}{advice}")
