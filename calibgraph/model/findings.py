"""The findings of a matcher beside its correspondences; on disk, keys of a table's metadata."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from calibgraph.errors import CorrespondenceError
from calibgraph.files import describe

_OF_ONE_SEARCH = ("found", "missed", "chance")
_PER_CAMERA = (
    "z_score", *_OF_ONE_SEARCH, "contradicted", "start_dependence", "memorization", "failed_share",
    "by_lidars",
)  # fmt: skip
IMAGES = "calibgraph_images"
"""Key of what the images said of a result; its content is of ``calibgraph.trust.image_record``."""
STAGE1 = "stage1"
_COMMON = {"systematic_rotation_rad", "systematic_translation_m"}


def _up_to(largest: float) -> Any:
    """A check that a number is in a range from zero."""
    return Field(strict=True, ge=0, le=largest)


_Number = Annotated[float, Field(strict=True)]
_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Angle = Annotated[float, _up_to(math.pi)]
_Length = Annotated[float, _up_to(100)]
_Share = Annotated[float, _up_to(1)]


@dataclass(frozen=True)
class MatcherFindings:
    """Quality and limits of a matcher's work. Mappings are by camera; all of it is optional.

    Attributes:
        z_score: agreement of image and cloud, in standard deviations of chance agreement.
        start_dependence: share of a displaced start that remains in the matches (0 to 1).
        memorization: share of the displacement that is undone with a blank image (0 to 1).
        failed_share: share of the frames without matches (0 to 1).
        found: z-score at the pose where the search found the camera.
        missed: best z-score of the search where it did not find the camera: the camera fails.
        chance: probability that a search with nothing to find ends at as high a z-score; of a
            search in one to three frames alone, which measures it (0 to 1).
        contradicted: by camera that the search found, the camera whose features place it elsewhere.
        by_lidars: (6, k) by how much a camera, in the tangent of T_lidar_camera, errs by a standard
            deviation of each error of the poses of other LiDARs, whose points it is matched with.
        stage1: ``rig`` if the matches of a single frame determine no pose, else ``pnp``.
        range_rotation_deg, range_translation_m: how far from the guess it searches, per axis; None
            if unknown.
        systematic_rotation_rad, systematic_translation_m: standard deviation per camera axis of the
            common error, which all its frames share; None if it is not stated.
        camera_share: share of its variance that is independent per camera; the cloud has the rest.
        elevation_rad: standard deviation of an offset of all beams' elevations; this and the next
            two are the scan distortion, a part of the error that all frames share.
        elevation_stretch: standard deviation of the relative scale of elevations.
        scan_motion_m: standard deviation of the uncompensated motion during a scan.
        place_rotation_rad, place_translation_m: standard deviation of a further error that all
            cameras share at one place.
        place_variance: variance of the error that frames of one place share, relative to one
            frame's matches if they were independent.
    """

    z_score: Mapping[str, _Finite] = field(default_factory=dict)
    start_dependence: Mapping[str, _Number] = field(default_factory=dict)
    memorization: Mapping[str, _Number] = field(default_factory=dict)
    failed_share: Mapping[str, _Number] = field(default_factory=dict)
    found: Mapping[str, _Finite] = field(default_factory=dict)
    missed: Mapping[str, _Finite] = field(default_factory=dict)
    chance: Mapping[str, _Finite] = field(default_factory=dict)
    contradicted: Mapping[str, str] = field(default_factory=dict)
    by_lidars: Mapping[str, list[list[_Finite]]] = field(default_factory=dict)
    stage1: Literal["pnp", "rig"] = "pnp"
    range_rotation_deg: Annotated[float | None, _up_to(180)] = None
    range_translation_m: Annotated[float | None, _up_to(100)] = None
    systematic_rotation_rad: Annotated[float | None, _up_to(math.pi)] = None
    systematic_translation_m: Annotated[float | None, _up_to(100)] = None
    camera_share: _Share = 0.5
    elevation_rad: _Angle = 0.0
    elevation_stretch: _Share = 0.0
    scan_motion_m: _Length = 0.0
    place_rotation_rad: _Angle = 0.0
    place_translation_m: _Length = 0.0
    place_variance: Annotated[float, _up_to(1e6)] = 0.0

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> MatcherFindings:
        """Read the keys of a table's metadata that are findings; others are left alone.

        Without a stated common error, the prior of its ``matcher`` is taken, if that is known.

        Raises:
            CorrespondenceError: if a value is not a number in its range.
        """
        if not metadata:
            return _NOTHING
        values = {key: metadata[key] for key in _KEYS & metadata.keys()}
        for key in values.keys() & {*_PER_CAMERA}:
            of = values[key] or {}
            values[key] = {str(name): of[name] for name in of} if isinstance(of, dict) else of
        matcher = metadata.get("matcher")
        if not _COMMON & values.keys() and isinstance(matcher, str) and matcher != UNKNOWN:
            values = error_components().matchers.get(matcher, {}) | values
        try:
            return _READER.validate_python(values) if values else MatcherFindings()
        except ValidationError as error:
            camera = next((str(name) for name in error.errors()[0]["loc"][1:2]), None)
            raise CorrespondenceError(f"metadata {describe(error)}", camera=camera) from error

    def to_metadata(self) -> dict[str, Any]:
        """As keys of the metadata; findings without a value have no key."""
        stated = ((item, getattr(self, item.name)) for item in fields(self))
        return {
            item.name: dict(value) if item.name in _PER_CAMERA else value
            for item, value in stated
            if value not in (None, {}, item.default)
        }

    @property
    def systematic_sigmas(self) -> tuple[float, float]:
        """Rotation [rad] and translation [m] that all frames share, per axis; 0 if not stated."""
        return self.systematic_rotation_rad or 0.0, self.systematic_translation_m or 0.0

    @property
    def states_common_error(self) -> bool:
        """Whether it is known how large the error is that all frames share."""
        return (self.systematic_rotation_rad, self.systematic_translation_m) != (None, None)

    @property
    def rigid_sigmas(self) -> tuple[float, float]:
        """Rigid part of the systematic error: the scan distortion is subtracted in quadrature."""
        bends = self.elevation_rad, self.scan_motion_m / (4 * math.pi)
        rotation, translation = (
            math.sqrt(max(whole**2 - bend**2, 0.0))
            for whole, bend in zip(self.systematic_sigmas, bends, strict=True)
        )
        return rotation, translation

    @property
    def bend_sigmas(self) -> tuple[float, float, float]:
        """Scan distortion: elevation offset [rad], elevation scale, uncompensated motion [m]."""
        return self.elevation_rad, self.elevation_stretch, self.scan_motion_m


_KEYS = {item.name for item in fields(MatcherFindings)}
_READER = TypeAdapter(MatcherFindings)
_NOTHING = MatcherFindings()


def joined_metadata(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The metadata of joined tables, by theirs, which are read: the first, with what holds for all.

    A common error is stated if all tables state it, as the largest. Where searches differ, only the
    cameras that one has missed remain of them, at their lowest. What images said is of one result,
    and of tables that share it; of others only the names of its cameras are kept.
    """
    joined = dict(tables[0])
    if any(one.get(IMAGES) != joined.get(IMAGES) for one in tables):
        joined[IMAGES] = _joined_images([one.get(IMAGES) for one in tables])
    for key in _COMMON:
        stated: list[Any] = [one.get(key) for one in tables]
        if None in stated:
            joined.pop(key, None)
        else:
            joined[key] = max(stated)
    searches = [{key: one.get(key) or {} for key in _OF_ONE_SEARCH} for one in tables]
    if all(one == searches[0] for one in searches):
        return joined
    missed: dict[str, float] = {}
    for camera, z_score in (item for one in searches for item in one["missed"].items()):
        missed[camera] = min(z_score, missed.get(camera, z_score))
    kept = {key: value for key, value in joined.items() if key not in _OF_ONE_SEARCH}
    return kept | ({"missed": missed} if missed else {})


def _joined_images(records: Sequence[Any]) -> dict[str, list[str]]:
    """The cameras of which any of the records is."""
    known = [record for record in records if isinstance(record, dict)]
    names = (
        name for record in known for key in ("cameras", "joined") for name in record.get(key, ())
    )
    return {"joined": sorted(map(str, {*names}))}


UNKNOWN = "unknown"
"""Stands for the matcher of a table that states nothing."""


@dataclass(frozen=True)
class ErrorComponents:
    """All parts of the file.

    Attributes:
        matchers: by name, the sizes of its errors, named as in ``MatcherFindings``.
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

    matchers: dict[str, dict[str, Any]]
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
    """The sizes that the error model begins with; ``error_components.json`` states their origin.

    A matcher's part goes into the metadata of its tables, so that a table remains what it was when
    the file changes.
    """
    text = (files("calibgraph.model") / "error_components.json").read_text(encoding="utf-8")
    content = json.loads(text)
    return ErrorComponents(
        matchers={name: _sizes(one) for name, one in content["matchers"].items()},
        **_sizes(content["pairs"]),
        **_sizes(content["frames"]),
        **_sizes(content["sizes"]),
    )


def _sizes(part: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a part of the file, by the names of their fields: angles in radians."""
    sizes = {name: value for name, value in part.items() if isinstance(value, (int, float))}
    for name in [name for name in sizes if name.endswith("_deg")]:
        sizes[f"{name.removesuffix('_deg')}_rad"] = float(np.radians(sizes.pop(name)))
    return sizes
