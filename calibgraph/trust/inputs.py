"""Quick checks of a dataset and its guess, before anything is matched."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.bags import scan_duration_s
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.matching.burnt_in import describe_burnt_in
from calibgraph.model.clock import OF_IMAGES, unused_times
from calibgraph.model.plausibility import find_implausible
from calibgraph.model.rig import Camera, Rig
from calibgraph.model.verdict import Check
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.joined_clouds import displacement_of_parts
from calibgraph.trust.motion_checks import motion_doubts
from calibgraph.trust.thresholds import threshold

_log = logging.getLogger(__name__)

Level = Literal["error", "warning", "note"]
Cloud = NDArray[np.float32]


@dataclass(frozen=True)
class Finding:
    """One line about a dataset: an error stops a calibration, a warning spoils it."""

    level: Level
    text: str


def describe_repeats(what: str, digests: Iterable[tuple[str, str]]) -> str:
    """A line on frames with the same cloud or image, which are not independent; empty if none are.

    Args:
        what: the cloud, or the image of a camera.
        digests: the name of each frame, and a digest of what it has.
    """
    first: dict[str, str] = {}
    repeated = [(first[d], name) for name, d in digests if first.setdefault(d, name) != name]
    if not repeated:
        return ""
    others = f", and {len(repeated) - 1} more repeat one" if repeated[1:] else ""
    one, other = repeated[0]
    return f"frames {one} and {other} have the same {what}{others}; leave repeats out"


def describe_copies(copies: Iterable[tuple[str, str]]) -> str:
    """A line on frames that were left out as copies; empty without any.

    Args:
        copies: the name of each, and of the frame that it is a copy of.
    """
    named = [(name, first) for copy, first in copies for name in (first, copy)]
    return describe_repeats("cloud and images", named)


_DARK, _BRIGHT = 30.0, 225.0  # of 255; images by day have 80 to 140, of a lit street at night 40


def describe_brightness(name: str, means: Sequence[float]) -> str:
    """Why the images of a camera show too little, by their mean gray levels; empty if they do not.

    Args:
        name: of the camera.
        means: of each image that was looked at, 0 to 255.
    """
    level = float(np.median(means)) if len(means) else _DARK
    if _DARK <= level <= _BRIGHT:
        return ""
    found, remedy = ("dark", "longer") if level < _DARK else ("bright", "shorter")
    return (
        f"the images of {name} are too {found} to show structure: their mean brightness is "
        f"{level:.0f} of 255; record by daylight, uncover the lens, or expose {remedy}"
    )


def find_doubts(rig: Rig, frame: Frame, cloud: Cloud) -> list[str]:
    """Warnings about the values of a rig and about a frame's cloud.

    Args:
        rig: the guess.
        frame: whose cloud it is.
        cloud: (n, >= 3) x y z [m] in the LiDAR frame.
    """
    return [*find_implausible(rig), *_doubts_about_cloud(frame, cloud)]


def _doubts_about_cloud(frame: Frame, cloud: Cloud) -> Iterator[str]:
    distance = _distance_check(cloud)
    if distance.status != "PASS":
        yield distance.text
        return
    displacement = displacement_of_parts(cloud)
    if displacement is not None:
        turned, moved = displacement
        yield (
            f"the cloud of frame {frame.name} holds the same surfaces twice, {turned:.2g} deg "
            f"and {moved:.2g} m apart: clouds joined with a wrong extrinsic, or before their "
            "motion was corrected?"
        )
    if frame.is_corrected and scan_duration_s(frame.cloud_path) == 0:
        yield (
            f"all points of the cloud of frame {frame.name} have the same time, so that --motion "
            "moves it as a whole: record the times of points, or leave --motion out if the driver "
            "corrects them"
        )


def _distance_check(cloud: Cloud) -> Check:
    """Whether a cloud can be in metres."""
    row = threshold("point_distance")
    median_m = float(np.median(np.linalg.norm(cloud[:, :3], axis=1)))
    centimetres = row.grade(median_m) == "WARN"  # in millimetres it would be a small room
    return row.check(median_m, advice="are the clouds in centimetres?" if centimetres else "")


def explain_guess(data: Dataset, rig: Rig, cloud: Cloud) -> str | None:
    """The convention error of the guess that the images show; not looked for in other units.

    Args:
        data: images and clouds.
        rig: the guess.
        cloud: (n, >= 3) one of the clouds.
    """
    return likely_intended_guess(data, rig) if _distance_check(cloud).status == "PASS" else None


def count_points_in_view(rig: Rig, cloud: Cloud) -> dict[str, int]:
    """Per camera, the number of cloud points in the image at the guess."""
    return {name: _count_seen(camera, cloud) for name, camera in rig.cameras.items()}


def _count_seen(camera: Camera, cloud: Cloud) -> int:
    T = camera.T_camera_lidar
    pixels, valid = camera.lens.project(cloud[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3])
    return int(np.sum(valid & camera.in_image(pixels)))


def describe_out_of_view(in_view: Mapping[str, int]) -> list[str]:
    """A line per camera without cloud points in view, by :func:`count_points_in_view`."""
    return [
        f"{name}: by the guess, no point of the cloud lies in the image"
        for name, count in in_view.items()
        if not count
    ]


def check_inputs(data: Dataset, rig: Rig, *, at_guess: bool = True) -> tuple[str, ...]:
    """Warnings about a dataset and its guess, before cameras are searched for; they are logged.

    Raises:
        FileError: if a cloud cannot be read.
        DatasetError: if no camera has points of a cloud in view. One that has none may still be
            placed by co-visible features.
    """
    known = data.frames[0].twist_per_s is not None
    doubts = _check_at_guess(data, rig) if at_guess else find_implausible(rig)
    doubts += motion_doubts(data)
    for text in doubts:
        _log.warning(text)
    known_times = unused_times(rig, is_known=known, how=OF_IMAGES)
    return (*known_times, *doubts, *describe_burnt_in(data))


def _check_at_guess(data: Dataset, rig: Rig) -> list[str]:
    frame = data.frames[len(data.frames) // 2]
    cloud = frame.load_cloud()
    doubts = find_doubts(rig, frame, cloud)
    out_of_view = describe_out_of_view(count_points_in_view(rig, cloud))
    if len(out_of_view) < len(rig.cameras):
        return [*doubts, *out_of_view]
    reasons = [explain_guess(data, rig, cloud), *doubts, *out_of_view]
    raise DatasetError("; ".join(reason for reason in reasons if reason))
