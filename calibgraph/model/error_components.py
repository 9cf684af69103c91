"""The sizes that the error model begins with, from ``error_components.json``.

The file states how each number was got. Its format has a version of its own; a matcher's part goes
into the metadata of its tables, so that a table remains what it was when the file changes.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

FORMAT = "calibgraph-error-components/1"

UNKNOWN = "unknown"
"""Stands for the matcher of a table that states nothing."""


@dataclass(frozen=True)
class MatcherComponents:
    """Standard deviations per axis of one matcher's errors.

    Attributes:
        systematic_rotation_rad, systematic_translation_m: error that all its frames share.
        camera_share: of its variance, what each camera has by itself; the cloud has the rest.
        elevation_rad: of an offset of all beams' elevations.
        elevation_stretch: of the share by which elevations are too far from the horizon.
        scan_motion_m: of the motion during a turn for which clouds are not corrected.
        place_rotation_rad, place_translation_m: further error that all cameras share at one place.
        place_variance: of what a camera's frames of a place share besides, over the variance of one
            frame's matches if they were independent.
    """

    systematic_rotation_rad: float
    systematic_translation_m: float
    camera_share: float
    elevation_rad: float
    elevation_stretch: float
    scan_motion_m: float
    place_rotation_rad: float
    place_translation_m: float
    place_variance: float


@dataclass(frozen=True)
class ErrorComponents:
    """All parts of the file.

    Attributes:
        matchers: by name.
        pair_rotation_rad, pair_translation_m: standard deviation per axis of a relative pose from
            images, which all frames share.
        pair_correlation: of the errors of two features of a pair in one frame.
        frame_correlation: of the errors of two matches of one frame, where frames are few.
        prior_frames: weight of that prior in frames.
        pseudo_frames: frames that are added with the scatter along each principal direction.
        shared_dof, place_dof: degrees of freedom of the priors.
        least_places: number of places from which their variance may fall below its prior.
        robust_sigmas: distance at which the loss of a place bends.
        robust_places: number of places from which there is one.
        contradiction_sigmas: from so far on a measured relative pose takes no part.
    """

    matchers: dict[str, MatcherComponents]
    pair_rotation_rad: float
    pair_translation_m: float
    pair_correlation: float
    frame_correlation: float
    prior_frames: float
    pseudo_frames: float
    shared_dof: float
    place_dof: float
    least_places: int
    robust_sigmas: float
    robust_places: int
    contradiction_sigmas: float


@cache
def error_components() -> ErrorComponents:
    """The content of the file of this version.

    Raises:
        ValueError: if the file has another format.
    """
    text = (files("calibgraph.model") / "error_components.json").read_text(encoding="utf-8")
    content = json.loads(text)
    if content["format"] != FORMAT:
        raise ValueError(f"error_components.json: expected {FORMAT}, found {content['format']!r}")
    pairs, frames, sizes = content["pairs"], content["frames"], content["sizes"]
    return ErrorComponents(
        matchers={
            name: MatcherComponents(
                systematic_rotation_rad=float(np.radians(one["systematic_rotation_deg"])),
                systematic_translation_m=one["systematic_translation_m"],
                camera_share=one["camera_share"],
                elevation_rad=float(np.radians(one["elevation_deg"])),
                elevation_stretch=one["elevation_stretch"],
                scan_motion_m=one["scan_motion_m"],
                place_rotation_rad=float(np.radians(one["place_rotation_deg"])),
                place_translation_m=one["place_translation_m"],
                place_variance=one["place_variance"],
            )
            for name, one in content["matchers"].items()
        },
        pair_rotation_rad=float(np.radians(pairs["rotation_deg"])),
        pair_translation_m=pairs["translation_m"],
        pair_correlation=pairs["correlation"],
        frame_correlation=frames["correlation"],
        prior_frames=frames["prior_frames"],
        pseudo_frames=frames["pseudo_frames"],
        shared_dof=sizes["shared_dof"],
        place_dof=sizes["place_dof"],
        least_places=sizes["least_places"],
        robust_sigmas=sizes["robust_sigmas"],
        robust_places=sizes["robust_places"],
        contradiction_sigmas=sizes["contradiction_sigmas"],
    )
