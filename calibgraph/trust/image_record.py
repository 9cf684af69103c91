"""What the images said of a result, kept with its table for those who solve that again.

A table shows what its matches agree on. That the images leave the pose open, or that a check of
them failed, it cannot show, so a second solve without them would be surer than the first. The
record has, per camera, where its images were looked at, the posterior about there, and the checks.
The posterior is taken over for any pose, since it is about the recording; the checks for the pose
and the lens that they were made for.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.files import describe
from calibgraph.model.findings import IMAGES
from calibgraph.model.geometry import pose_difference, twist_between
from calibgraph.model.lens_difference import corner_distance_px, has_other_lens
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.image_posteriors import MeasurePosteriors
from calibgraph.trust.pose_posterior import PosePosterior

_SAME_SIGMAS = 1.0  # along every axis: at such a pose the images say the same
_SAME_PX = 0.5  # in the corners: such a lens is the same


def _read_samples(value: Any) -> Any:
    """(n, 6) from base64 of single precision, a quarter of the digits' size."""
    if not isinstance(value, str):
        return value
    samples = np.frombuffer(base64.b64decode(value, validate=True), "<f4")
    if not len(samples) or len(samples) % 6 or not np.isfinite(samples).all():
        raise ValueError("expected base64 of finite (n, 6) single-precision numbers")
    return samples.reshape(-1, 6).astype(np.float64)


def _write_samples(samples: Array) -> str:
    return base64.b64encode(samples.astype("<f4").tobytes()).decode()


_Samples = Annotated[Any, BeforeValidator(_read_samples), PlainSerializer(_write_samples)]


class _Posterior(BaseModel):
    near: _Samples
    elsewhere: _Samples
    share: float


class _Seen(BaseModel):
    """One camera: how it was when its images were looked at, and what they said."""

    model_config = ConfigDict(frozen=True)

    camera: Camera
    causes: tuple[Check, ...] = ()
    checks: tuple[Check, ...] = ()
    posterior: _Posterior | None = None


class _Record(BaseModel):
    cameras: dict[str, _Seen] = {}


@dataclass(frozen=True)
class RunChecks:
    """The checks of a run, by what they need.

    Attributes:
        of_solution: per camera, those that a table is enough for.
        of_run: those of its images, clouds and rounds.
        causes: what explains the failure of others; they come first.
        with_images: whether the images were looked at.
    """

    of_solution: Checks
    of_run: Checks = field(default_factory=dict)
    causes: Checks = field(default_factory=dict)
    with_images: bool = True


def to_metadata(evidence: Evidence, checks: RunChecks) -> dict[str, Any]:
    """The record of a run, as a key of its table's metadata."""
    cameras = evidence.solution.solved_rig.cameras
    record = _Record(
        cameras={
            name: _Seen(
                camera=cameras[name].model_copy(update={"covariance": None}),
                causes=tuple(checks.causes.get(name, ())),
                checks=tuple(checks.of_run.get(name, ())),
                posterior=_posterior_of(evidence, name),
            )
            for name in evidence.cameras
        }
    )
    return {IMAGES: record.model_dump(mode="json")}


def _posterior_of(evidence: Evidence, name: str) -> _Posterior | None:
    if name not in evidence.posteriors:
        return None
    of = evidence.posteriors[name]
    return _Posterior(near=of.near, elsewhere=of.elsewhere, share=of.share)


@dataclass(frozen=True)
class ImageRecord:
    """The record of a table, which may be empty: of a table that no run has left."""

    cameras: Mapping[str, _Seen]

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> ImageRecord:
        """Read the key of a table's metadata.

        Raises:
            CorrespondenceError: if it is malformed.
        """
        try:
            return ImageRecord(_Record.model_validate(metadata.get(IMAGES, {})).cameras)
        except ValidationError as error:
            raise CorrespondenceError(f"metadata {IMAGES!r}: {describe(error)}") from error

    def posteriors_of(self, cameras: Mapping[str, Camera]) -> MeasurePosteriors:
        """What gives the posteriors about solved cameras that have the lens that was looked at."""
        return lambda _, groups: self._posteriors(cameras, groups)

    def _posteriors(
        self, rig: Mapping[str, Camera], groups: Sequence[Sequence[str]]
    ) -> dict[str, PosePosterior]:
        found = {}
        for name in (name for group in groups for name in group if name in self.cameras):
            seen, camera = self.cameras[name], rig[name]
            if seen.posterior is None or not _same_lens(seen.camera, camera):
                continue
            away = twist_between(seen.camera.T_camera_lidar, camera.T_camera_lidar)
            near, elsewhere = seen.posterior.near + away, seen.posterior.elsewhere + away
            found[name] = PosePosterior(near, elsewhere, seen.posterior.share)
        return found

    def checks(self, evidence: Evidence, of_solution: Checks) -> RunChecks:
        """Those of a solution of the table, with the recorded ones if they are of this solution."""
        if not self.cameras:
            return RunChecks(of_solution, with_images=False)
        moved = {name: text for name in self.cameras if (text := self._moved(evidence, name))}
        if moved:
            return RunChecks(
                of_solution,
                {name: [Check("images", "WARN", text)] for name, text in moved.items()},
                with_images=False,
            )
        seen = {name: seen for name, seen in self.cameras.items() if name in evidence.cameras}
        return RunChecks(
            of_solution,
            {name: of.checks for name, of in seen.items()},
            {name: of.causes for name, of in seen.items()},
        )

    def _moved(self, evidence: Evidence, name: str) -> str:
        """Why what was seen is not of this camera of a solution; empty if it is."""
        camera, seen = evidence.solution.solved_rig.cameras.get(name), self.cameras[name].camera
        if camera is None:
            return ""
        advice = "was compared with its images"
        if not _same_lens(seen, camera):
            return f"another lens {advice}"
        covariance = evidence.covariance_by_matches(name)
        if covariance is None:
            return ""
        away = twist_between(camera.T_camera_lidar, seen.T_camera_lidar)
        if (np.abs(away) <= _SAME_SIGMAS * np.sqrt(np.diag(covariance))).all():
            return ""
        degrees, centimetres = pose_difference(camera.T_camera_lidar, seen.T_camera_lidar)
        return f"a pose {degrees:.2g} deg, {centimetres:.2g} cm from this one {advice}"


def _same_lens(seen: Camera, camera: Camera) -> bool:
    return not has_other_lens(seen, camera) or corner_distance_px(seen, camera) <= _SAME_PX
