"""The sizes that the error model begins with, from ``error_components.json``.

The file states how each number was got. Its format has a version of its own; a matcher's part goes
into the metadata of its tables, so that a table remains what it was when the file changes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

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
    frames = _sizes(content["frames"])
    return ErrorComponents(
        matchers={
            name: MatcherComponents(**_sizes(one)) for name, one in content["matchers"].items()
        },
        **{f"pair_{name}": size for name, size in _sizes(content["pairs"]).items()},
        frame_correlation=frames.pop("correlation"),
        **frames,
        **_sizes(content["sizes"]),
    )


def _sizes(part: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a part of the file, by the names of their fields: angles in radians."""
    sizes = {name: value for name, value in part.items() if isinstance(value, (int, float))}
    for name in [name for name in sizes if name.endswith("_deg")]:
        sizes[f"{name.removesuffix('_deg')}_rad"] = float(np.radians(sizes.pop(name)))
    return sizes
