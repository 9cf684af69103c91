"""What the images said of a result, kept with its table for those who solve that again.

A table shows what its matches agree on. That the images leave the pose open, or that a check of
them failed, it cannot show, so a second solve without them would be surer than the first. The
record has, per camera, where its images were looked at, the posterior about there, and the checks.
The posterior is taken over for any pose, since it is about the recording; the checks for the pose,
the lens and the clock that they were made for. A camera of which none are taken over is told so.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from calibgraph.errors import CorrespondenceError
from calibgraph.files import describe
from calibgraph.model.findings import IMAGES
from calibgraph.model.geometry import pose_difference, twist_between
from calibgraph.model.lens import has_other_lens, lens_difference
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.pose_posterior import PosePosterior

_SAME_SIGMAS = 1.0  # along every axis: at such a pose the images say the same
_SAME_PX, _GRID = 0.5, 9  # all over the image, so many pixels a side: such a lens is the same
_EXCLUDED_SIGMAS = 6.0  # of six numbers, by chance three in a million
_SAME_S = 1e-4  # of both times of the image: such a clock is the same


class _Seen(BaseModel):
    """One camera: how it was when its images were looked at, and what they said."""

    model_config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)

    camera: Camera
    causes: tuple[Check, ...] = ()
    checks: tuple[Check, ...] = ()
    posterior: PosePosterior | None = None


class ImageRecord(BaseModel):
    """Of a run; of joined tables, the cameras that several runs have looked at; else empty."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["calibgraph-images/1"] = "calibgraph-images/1"
    tolerance: tuple[float, float] = TOLERANCE
    cameras: dict[str, _Seen] = {}
    joined: tuple[str, ...] = ()

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> ImageRecord:
        """Read the key of a table's metadata.

        Raises:
            CorrespondenceError: if it is malformed.
        """
        try:
            return ImageRecord.model_validate(metadata.get(IMAGES) or {})
        except ValidationError as error:
            raise CorrespondenceError(f"metadata {IMAGES!r}: {describe(error)}") from error

    def posteriors_of(self, solution: Solution) -> dict[str, PosePosterior]:
        """The posteriors about solved cameras that have the lens that was looked at."""
        solved = {} if solution.covariance is None else solution.solved_rig.cameras
        both = {n: (of, solved[n]) for n, of in self.cameras.items() if n in solved}
        return {
            name: of.posterior.from_another(
                twist_between(of.camera.T_camera_lidar, camera.T_camera_lidar)
            )
            for name, (of, camera) in both.items()
            if name not in solution.held and of.posterior and _same_lens(of.camera, camera)
        }

    def join(self, evidence: Evidence, of_solution: Checks) -> tuple[Checks, Collection[str]]:
        """Checks of a solution of the table, with what was recorded of the cameras as they are.

        And the cameras of which nothing was.
        """
        if not self.cameras and not self.joined:
            return of_solution, evidence.cameras
        same = evidence.solution.config.tolerance == self.tolerance
        narrower = [] if same else [_not_compared(self._judged)]
        other = {name: self._compare(evidence, name) for name in evidence.cameras}
        unseen = {name: [*of_solution[name], each] for name, each in other.items() if each}
        seen = {name: self.cameras[name] for name in other.keys() - unseen.keys()}
        joined = {n: [*of.causes, *of_solution[n], *of.checks, *narrower] for n, of in seen.items()}
        return joined | unseen, unseen

    @property
    def _judged(self) -> str:
        return "its images were judged for a tolerance of {:g} deg, {:g} cm".format(*self.tolerance)

    def _compare(self, evidence: Evidence, name: str) -> Check | None:
        """Why nothing that was seen is of this camera of a solution; None if it is.

        A FAIL if the recorded posterior excludes the pose of a camera with the same lens.
        """
        if name in self.joined or name not in self.cameras:
            several = "the joined tables are of several runs"
            unseen = "its images were not compared with clouds"
            return _not_compared(several if name in self.joined else unseen)
        of, camera = self.cameras[name], evidence.solution.solved_rig.cameras[name]
        seen, tolerance = of.camera, evidence.solution.config.tolerance
        same_lens, same_clock = _same_lens(seen, camera), _same_clock(seen, camera)
        away = twist_between(camera.T_camera_lidar, seen.T_camera_lidar)
        degrees, cm = pose_difference(camera.T_camera_lidar, seen.T_camera_lidar)
        apart = f"{degrees:.2g} deg, {cm:.2g} cm"
        near = degrees <= tolerance[0] and cm <= tolerance[1]
        if (covariance := evidence.covariance_by_matches(name)) is not None:
            near = bool((np.abs(away) <= _SAME_SIGMAS * np.sqrt(np.diag(covariance))).all())
        wider = tolerance[0] > self.tolerance[0] or tolerance[1] > self.tolerance[1]
        differences = (
            (wider, self._judged),
            (not same_lens, "another lens was compared with its images"),
            (not same_clock, "another time of its images was compared"),
            (not near, f"a pose {apart} from this one was compared with its images"),
        )
        why = next((text for differs, text in differences if differs), "")
        if why and of.posterior and same_lens and same_clock and covariance is not None:
            total = of.posterior.moments + covariance
            if away @ np.linalg.solve(total, away) >= _EXCLUDED_SIGMAS**2:
                text = (
                    f"its images exclude this pose: with them it was {apart} away; the table was "
                    "changed since, or is of another rig"
                )
                return Check("images", "FAIL", text)
        return _not_compared(why) if why else None


def to_metadata(evidence: Evidence, causes: Checks, checks: Checks) -> dict[str, Any]:
    """The record of a run, by its own checks and the causes, as a key of its table's metadata."""
    cameras = evidence.solution.solved_rig.cameras
    seen = {
        name: _Seen.model_construct(
            camera=cameras[name].model_copy(update={"covariance": None}),
            causes=tuple(causes[name]),
            checks=tuple(checks[name]),
            posterior=evidence.posteriors.get(name),
        )
        for name in evidence.cameras
    }
    tolerance = evidence.solution.config.tolerance
    record = ImageRecord.model_construct(tolerance=tolerance, cameras=seen)
    return {IMAGES: record.model_dump(mode="json")}


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
    sides = [np.linspace(0.0, size - 1.0, _GRID) for size in (seen.width_px, seen.height_px)]
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    apart = np.hypot(*lens_difference(seen, camera, pixels).T)
    known = apart[np.isfinite(apart)]
    return bool(len(known)) and float(known.max()) <= _SAME_PX
