"""The findings of a matcher beside its correspondences; on disk, keys of a table's metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from calibgraph.errors import CorrespondenceError
from calibgraph.model.error_components import UNKNOWN, error_components

_FINITE = ("z_score", "found", "missed", "chance")
_OF_ONE_SEARCH = ("found", "missed", "chance")
_PER_CAMERA = (*_FINITE, "start_dependence", "memorization", "failed_share")
_FORMER_KEYS = {"contrast": "z_score", "recall": "memorization"}
IMAGES = "calibgraph_images"
"""Key of what the images said of a result; its content is of ``calibgraph.trust.image_record``."""
STAGE1, _SOURCES = "stage1", ("pnp", "rig")
_NUMBERS = {
    "range_rotation_deg": 180.0,
    "range_translation_m": 100.0,
    "systematic_rotation_rad": math.pi,
    "systematic_translation_m": 100.0,
    "camera_share": 1.0,
    "elevation_rad": math.pi,
    "elevation_stretch": 1.0,
    "scan_motion_m": 100.0,
    "place_rotation_rad": math.pi,
    "place_translation_m": 100.0,
    "place_variance": 1e6,
}
_COMMON = {"systematic_rotation_rad", "systematic_translation_m"}


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

    z_score: Mapping[str, float] = field(default_factory=dict)
    start_dependence: Mapping[str, float] = field(default_factory=dict)
    memorization: Mapping[str, float] = field(default_factory=dict)
    failed_share: Mapping[str, float] = field(default_factory=dict)
    found: Mapping[str, float] = field(default_factory=dict)
    missed: Mapping[str, float] = field(default_factory=dict)
    chance: Mapping[str, float] = field(default_factory=dict)
    stage1: str = "pnp"
    range_rotation_deg: float | None = None
    range_translation_m: float | None = None
    systematic_rotation_rad: float | None = None
    systematic_translation_m: float | None = None
    camera_share: float = 0.5
    elevation_rad: float = 0.0
    elevation_stretch: float = 0.0
    scan_motion_m: float = 0.0
    place_rotation_rad: float = 0.0
    place_translation_m: float = 0.0
    place_variance: float = 0.0

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> MatcherFindings:
        """Read the keys of a table's metadata that are findings; others are left alone.

        Without a stated common error, the prior of its ``matcher`` is taken, if that is known.

        Raises:
            CorrespondenceError: if a value is not a number in its range.
        """
        former = {_FORMER_KEYS[key]: metadata[key] for key in _FORMER_KEYS if key in metadata}
        metadata = {**former, **metadata}
        values: dict[str, Any] = {key: _by_camera(metadata, key) for key in _PER_CAMERA}
        for key, largest in _NUMBERS.items():
            if key in metadata:
                values[key] = _number(key, metadata[key], largest)
        if STAGE1 in metadata:
            values[STAGE1] = _source(metadata[STAGE1])
        if not _COMMON & values.keys():
            values = _prior_of(metadata.get("matcher")) | values
        return MatcherFindings(**values)

    def to_metadata(self) -> dict[str, Any]:
        """As keys of the metadata; findings without a value have no key."""
        content: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in _PER_CAMERA:
                content |= {item.name: dict(value)} if value else {}
            elif value is not None and value != item.default:
                content[item.name] = value
        return content

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


def joined_metadata(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The metadata of joined tables, by theirs: the first, with what holds for all.

    A common error is stated if all tables state it, as the largest. Where searches differ, only the
    cameras that one has missed remain of them, at their lowest. What images said is of one result,
    and of tables that share it; of others only the names of its cameras are kept.
    """
    joined = dict(tables[0])
    if any(one.get(IMAGES) != joined.get(IMAGES) for one in tables):
        joined[IMAGES] = _joined_images([one.get(IMAGES) for one in tables])
    for key in _COMMON:
        stated = [one.get(key) for one in tables]
        if None in stated:
            joined.pop(key, None)
        else:
            joined[key] = max(stated, key=_size)
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


def _size(value: Any) -> float:
    """Infinite for what is no number, so that it is kept, and refused when it is read."""
    number = _to_float(value)
    return number if isinstance(number, float) else math.inf


def _prior_of(matcher: object) -> dict[str, float]:
    """The error sizes of a known matcher; empty for others, whose tables have to state them."""
    known = error_components().matchers
    named = isinstance(matcher, str) and matcher in known and matcher != UNKNOWN
    return vars(known[str(matcher)]) if named else {}


def _by_camera(metadata: Mapping[str, Any], key: str) -> dict[str, float]:
    values = metadata.get(key) or {}
    if not isinstance(values, dict):
        raise CorrespondenceError(
            f"metadata {key!r} must map camera names to numbers, found {values!r}"
        )
    for camera, value in values.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise CorrespondenceError(
                f"metadata {key!r} must map camera names to numbers, found {values!r}",
                camera=camera,
            )
        if key in _FINITE and not math.isfinite(_to_float(value)):
            raise CorrespondenceError(
                f"metadata {key!r} must be finite, found {_to_float(value)!r}", camera=camera
            )
    return {camera: _to_float(value) for camera, value in values.items()}


def _number(key: str, value: Any, largest: float) -> float:
    number = _to_float(value)
    if isinstance(value, bool) or not (isinstance(number, float) and 0 <= number <= largest):
        raise CorrespondenceError(
            f"metadata {key!r} must be a number from 0 to {largest:.3g}, found {number!r}"
        )
    return number


def _source(value: Any) -> str:
    if value not in _SOURCES:
        raise CorrespondenceError(
            f"metadata {STAGE1!r} must be {' or '.join(_SOURCES)}, found {value!r:.40}"
        )
    return str(value)


def _to_float(value: Any) -> Any:
    """A whole number as a float, infinite if it is too large; anything else as it is."""
    try:
        return float(value) if isinstance(value, int) else value
    except OverflowError:
        return math.inf if value > 0 else -math.inf
