"""What the images said of a result, kept with its table for those who solve that again.

A table shows what its matches agree on. That the images leave the pose open, or that a check of
them failed, it cannot show, so a second solve without them would be surer than the first. The
record has, per camera, where its images were looked at, the posterior about there, and the checks.
The posterior is taken over for any pose, since it is about the recording; the checks for the pose,
the lens and the clock that they were made for. A camera of which none are taken over is told so.
"""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.files import describe
from calibgraph.model.findings import IMAGES
from calibgraph.model.geometry import pose_difference, twist_between
from calibgraph.model.lens import has_other_lens, lens_difference
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.pose_posterior import MeasurePosteriors, PosePosterior

_SAME_SIGMAS = 1.0  # along every axis: at such a pose the images say the same
_SAME_PX, _GRID = 0.5, 9  # all over the image, so many pixels a side: such a lens is the same
_EXCLUDED_SIGMAS = 6.0  # of six numbers, by chance three in a million
_SAME_S = 1e-4  # of both times of the image: such a clock is the same


def _read_samples(value: Any) -> Array:
    """(n, 6) from base64 of half precision, a tenth of the digits' size."""
    if not isinstance(value, str):
        raise ValueError("expected base64")
    samples = np.frombuffer(base64.b64decode(value, validate=True), "<f2")
    if not len(samples) or len(samples) % 6 or not np.isfinite(samples).all():
        raise ValueError("expected base64 of finite (n, 6) half-precision numbers")
    return samples.reshape(-1, 6).astype(np.float64)


def _write_samples(samples: Array) -> str:
    return base64.b64encode(samples.astype("<f2").tobytes()).decode()


_Samples = Annotated[Any, BeforeValidator(_read_samples), PlainSerializer(_write_samples)]


class _Posterior(BaseModel):
    model_config = ConfigDict(extra="forbid")

    near: _Samples
    elsewhere: _Samples
    share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class _Seen(BaseModel):
    """One camera: how it was when its images were looked at, and what they said."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera: Camera
    causes: tuple[Check, ...] = ()
    checks: tuple[Check, ...] = ()
    posterior: _Posterior | None = None


class _Record(BaseModel):
    """Of a run; of joined tables, the cameras that several runs have looked at."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["calibgraph-images/1"] = "calibgraph-images/1"
    tolerance: tuple[float, float] = TOLERANCE
    cameras: dict[str, _Seen] = {}
    joined: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunChecks:
    """The checks of a run, by what they need: a table, or its images, clouds and rounds.

    ``causes`` explain the failure of others; ``unseen`` cameras have images that were not looked
    at.
    """

    of_solution: Checks
    of_run: Checks = field(default_factory=dict)
    causes: Checks = field(default_factory=dict)
    unseen: Collection[str] = ()


def to_metadata(evidence: Evidence, checks: RunChecks) -> dict[str, Any]:
    """The record of a run, as a key of its table's metadata."""
    cameras = evidence.solution.solved_rig.cameras
    posteriors = {
        name: _Posterior.model_construct(near=of.near, elsewhere=of.elsewhere, share=of.share)
        for name, of in evidence.posteriors.items()
    }
    seen = {
        name: _Seen.model_construct(
            camera=cameras[name].model_copy(update={"covariance": None}),
            causes=tuple(checks.causes.get(name, ())),
            checks=tuple(checks.of_run.get(name, ())),
            posterior=posteriors.get(name),
        )
        for name in evidence.cameras
    }
    tolerance = evidence.solution.config.tolerance
    record = _Record.model_construct(tolerance=tolerance, cameras=seen)
    return {IMAGES: record.model_dump(mode="json")}


@dataclass(frozen=True)
class ImageRecord:
    """The record of a table, which may be empty: of a table that no run has left."""

    content: _Record

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> ImageRecord:
        """Read the key of a table's metadata.

        Raises:
            CorrespondenceError: if it is malformed.
        """
        try:
            return ImageRecord(_Record.model_validate(metadata.get(IMAGES) or {}))
        except ValidationError as error:
            raise CorrespondenceError(f"metadata {IMAGES!r}: {describe(error)}") from error

    def posteriors_of(self, cameras: Mapping[str, Camera]) -> MeasurePosteriors:
        """What gives the posteriors about solved cameras that have the lens that was looked at."""
        known = self.content.cameras

        def measure(_: Any, groups: Sequence[Sequence[str]]) -> dict[str, PosePosterior]:
            found = {}
            for name in (name for group in groups for name in group if name in known):
                seen, camera = known[name], cameras[name]
                if seen.posterior is None or not _same_lens(seen.camera, camera):
                    continue
                away = twist_between(seen.camera.T_camera_lidar, camera.T_camera_lidar)
                near, elsewhere = seen.posterior.near + away, seen.posterior.elsewhere + away
                found[name] = PosePosterior(near, elsewhere, seen.posterior.share)
            return found

        return measure

    def checks(self, evidence: Evidence, of_solution: Checks) -> RunChecks:
        """Those of a solution of the table, with what was recorded of the cameras as they are."""
        if not self.content.cameras and not self.content.joined:
            return RunChecks(of_solution, unseen=evidence.cameras)
        other = {name: self._other_than_seen(evidence, name) for name in evidence.cameras}
        seen = {name: self.content.cameras[name] for name, text in other.items() if not text}
        (deg, cm), wanted = self.content.tolerance, evidence.solution.config.tolerance
        judged = f"its images were judged for a tolerance of {deg:g} deg, {cm:g} cm"
        wider = [] if wanted == self.content.tolerance else [_not_compared(judged)]
        of_run = {name: [*of.checks, *wider] for name, of in seen.items()}
        told = {
            name: [self._contradiction(evidence, name) or _not_compared(text)]
            for name, text in other.items()
            if text
        }
        causes = {name: of.causes for name, of in seen.items()}
        return RunChecks(of_solution, {**of_run, **told}, causes, [*told])

    def _contradiction(self, evidence: Evidence, name: str) -> Check | None:
        """A FAIL if the recorded posterior excludes the pose of a camera with the same lens."""
        seen, covariance = self.content.cameras.get(name), evidence.covariance_by_matches(name)
        camera = evidence.solution.solved_rig.cameras[name]
        if seen is None or seen.posterior is None or covariance is None:
            return None
        if not (_same_lens(seen.camera, camera) and _same_clock(seen.camera, camera)):
            return None
        of = seen.posterior
        moments = PosePosterior(of.near, of.elsewhere, of.share).moments
        away = twist_between(camera.T_camera_lidar, seen.camera.T_camera_lidar)
        if away @ np.linalg.solve(moments + covariance, away) < _EXCLUDED_SIGMAS**2:
            return None
        degrees, cm = pose_difference(camera.T_camera_lidar, seen.camera.T_camera_lidar)
        text = (
            f"its images exclude this pose: with them it was {degrees:.2g} deg, {cm:.2g} cm away; "
            "the table was changed since, or is of another rig"
        )
        return Check("images", "FAIL", text)

    def _other_than_seen(self, evidence: Evidence, name: str) -> str:
        """Why nothing that was seen is of this camera of a solution; empty if it is."""
        if name in self.content.joined:
            return "the joined tables are of several runs"
        if name not in self.content.cameras:
            return "its images were not compared with clouds"
        seen, camera = self.content.cameras[name].camera, evidence.solution.solved_rig.cameras[name]
        (deg, cm), tolerance = self.content.tolerance, evidence.solution.config.tolerance
        if tolerance[0] > deg or tolerance[1] > cm:
            return f"its images were judged for a tolerance of {deg:g} deg, {cm:g} cm"
        if not _same_lens(seen, camera):
            return "another lens was compared with its images"
        if not _same_clock(seen, camera):
            return "another time of its images was compared"
        covariance = evidence.covariance_by_matches(name)
        away = pose_difference(camera.T_camera_lidar, seen.T_camera_lidar)
        if covariance is None:
            near = away[0] <= tolerance[0] and away[1] <= tolerance[1]
        else:
            twist = twist_between(camera.T_camera_lidar, seen.T_camera_lidar)
            near = bool((np.abs(twist) <= _SAME_SIGMAS * np.sqrt(np.diag(covariance))).all())
        words = f"a pose {away[0]:.2g} deg, {away[1]:.2g} cm from this one"
        return "" if near else f"{words} was compared with its images"


def _not_compared(why: str) -> Check:
    return Check("images", "WARN", f"{why}; calibrate again from images and clouds")


def _same_clock(seen: Camera, camera: Camera) -> bool:
    one, two = ([c.time_offset_s or 0.0, c.readout_s or 0.0] for c in (seen, camera))
    return bool(np.allclose(one, two, rtol=0.0, atol=_SAME_S))


def _same_lens(seen: Camera, camera: Camera) -> bool:
    """Whether two lenses see alike all over the image, where both see anything."""
    if not has_other_lens(seen, camera):
        return True
    if (seen.width_px, seen.height_px) != (camera.width_px, camera.height_px):
        return False
    columns, rows = (
        np.linspace(0.0, size - 1.0, _GRID) for size in (seen.width_px, seen.height_px)
    )
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    apart = np.hypot(*lens_difference(seen, camera, pixels).T)
    known = apart[np.isfinite(apart)]
    return bool(len(known)) and float(known.max()) <= _SAME_PX
