"""The matcher ``cmrnext``: a schedule of networks from coarse to fine, and its findings."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.cmrnext.checkpoint import Checkpoint, load_checkpoint
from calibgraph.matching.cmrnext.flow_matching import (
    FlowMatcher,
    ImageResult,
    MatchingJob,
    load_job,
    lower_by_residuals,
    to_findings,
)
from calibgraph.matching.cmrnext.inputs import View
from calibgraph.matching.cmrnext.network import torch_device
from calibgraph.model.config import Config, Stage1Source
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import angle_deg, relative_transform, transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.progress import Progress
from calibgraph.solver.pnp import frame_pose

_PROBED_FRAMES = 5  # per camera
_BEYOND = 2.0  # times the range of training, corner to corner: no network corrects by more


class CmrNextMatcher:
    """Matching by CMRNext networks, from coarse to fine.

    Each network starts at the pose of the same image by the network before, by PnP, as in the
    original; frames that fail are left out.

    Args:
        weights: files of weights, in the order in which the networks are run; a file may be given
            more than once.
        device: ``cpu``, ``cuda``, or ``auto``.
        iterations: of the recurrent update.
        half_resolution: whether images are halved; None: from 1400 pixels width on.
        seed: of PnP.

    Raises:
        FileError: if a file is missing, damaged, or not of a CMRNext network.
        ValueError: on a wrong argument.
    """

    rounds = 1
    stage1: Stage1Source = "pnp"

    def __init__(
        self,
        weights: Sequence[Path | str],
        *,
        device: str = "auto",
        iterations: int = 12,
        half_resolution: bool | None = None,
        seed: int = 0,
    ) -> None:
        if not weights:
            raise ValueError("no weights given: --weights iter1.tar --weights iter5.tar")
        if iterations < 1:
            raise ValueError(f"iterations {iterations}: expected at least 1")
        self.device = torch_device(device)
        self.iterations = iterations
        self.half_resolution = half_resolution
        self.seed = seed
        loaded = {path: self._load(path) for path in dict.fromkeys(map(str, weights))}
        self.networks = [loaded[str(path)] for path in weights]

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Match every camera in every frame, from the rig's extrinsics."""
        views = {name: View(camera, crop_even=True) for name, camera in rig.cameras.items()}
        probed = {frame.index for frame in spread_out(dataset.frames, _PROBED_FRAMES)}
        results: dict[str, list[ImageResult]] = {name: [] for name in rig.cameras}
        for done, frame in enumerate(dataset.frames):
            progress(f"matching {frame.name}", done, len(dataset.frames))
            for name, camera in rig.cameras.items():
                result = self._run(load_job(frame, name, camera, views[name]))
                if frame.index in probed:
                    result = self._probe(result, self.networks[-1])
                results[name].append(result)
        # Of a camera whose images all failed, all are given: the solve reports the failure.
        good = [[r for r in each if not r.failed] or each for each in results.values()]
        tables = [result.matches for each in good for result in each]
        findings = to_findings(results)
        metadata = {
            **self._metadata(),
            "failed_frames": {
                n: [r.job.frame.name for r in e if r.failed] for n, e in results.items()
            },
        }
        return concatenate(tables).with_metadata(metadata).with_findings(findings)

    def _load(self, path: str) -> FlowMatcher:
        checkpoint = load_checkpoint(path)
        return FlowMatcher(
            checkpoint,
            checkpoint.network(self.device),
            iterations=self.iterations,
            half_resolution=self.half_resolution,
        )

    def _run(self, job: MatchingJob) -> ImageResult:
        """Run the networks on an image, each from the estimate of the one before."""
        failed = False
        for network in self.networks:
            result = self._estimate(job, network.match(job), network.checkpoint, failed)
            failed = result.failed
            if result.T_camera_lidar is not None and not failed:
                job = replace(job, T_camera_lidar=result.T_camera_lidar)
        return result

    def _estimate(
        self, job: MatchingJob, table: Correspondences, checkpoint: Checkpoint, failed: bool
    ) -> ImageResult:
        """Estimate an image's pose from its matches, and lower the confidence of its outliers."""
        T_camera_lidar = frame_pose(job.camera, table, Config(seed=self.seed))
        if T_camera_lidar is None:
            return ImageResult(job, table, None, failed=True)
        failed = failed or not _is_within_range(checkpoint, job, T_camera_lidar)
        return ImageResult(job, _weigh(job, table, T_camera_lidar), T_camera_lidar, failed)

    def _probe(self, result: ImageResult, network: FlowMatcher) -> ImageResult:
        """Match again from a displaced start: with the image, and with a blank one."""
        job = result.job
        base = job.T_camera_lidar if result.T_camera_lidar is None else result.T_camera_lidar
        rng = np.random.default_rng([self.seed, job.frame.index])
        start = displace(base, network.checkpoint.range_deg_m, rng)
        blank = np.full_like(job.image, BLANK)
        with_image, without_image = (
            network.match(replace(job, T_camera_lidar=start, image=image))
            for image in (job.image, blank)
        )
        dependence, kept = (
            remaining_share(job.camera, base, start, table) for table in (with_image, without_image)
        )
        return replace(result, start_dependence=dependence, memorization=1.0 - kept)

    def _metadata(self) -> dict[str, Any]:
        return {
            "matcher": "cmrnext",
            "schedule": [
                {"file": n.checkpoint.path.name, "sha256": n.checkpoint.sha256,
                 "range_deg_m": n.checkpoint.range_deg_m}
                for n in self.networks
            ],
            "iterations": self.iterations,
            "half_resolution": self.half_resolution,
            "device": self.device.type,
            "seed": self.seed,
            "confidence": "uncalibrated",
        }  # fmt: skip


def _is_within_range(checkpoint: Checkpoint, job: MatchingJob, T_camera_lidar: Array) -> bool:
    """Whether the network can have been trained for a correction of this size."""
    if checkpoint.range_deg_m is None:
        return True
    delta = relative_transform(T_camera_lidar, job.T_camera_lidar)
    most_deg, most_m = (_BEYOND * np.sqrt(3.0) * most for most in checkpoint.range_deg_m)
    length = float(np.linalg.norm(delta[:3, 3]))
    return bool(angle_deg(delta[:3, :3]) <= most_deg and length <= most_m)


def _weigh(job: MatchingJob, table: Correspondences, T_camera_lidar: Array) -> Correspondences:
    """The matches with their confidence lowered by their residuals."""
    projected, valid = job.camera.lens.project(table.points_lidar_m, T_camera_lidar)
    apart_px = np.linalg.norm(projected - table.pixels_px, axis=1)
    residuals = np.where(valid, apart_px, np.inf)
    return replace(table, confidence=lower_by_residuals(table.confidence, residuals))


BLANK = (124, 116, 104)
"""The mean colour of the networks' training: zero, once normalised."""

_SHARE_OF_RANGE = 0.7  # displacement per axis, as a share of the training's perturbation
_DEFAULT_RANGE = (0.2, 0.05)  # degrees and metres: the finest published network's
_MIN_POINTS = 50


def displace(
    T_camera_lidar: Array, range_deg_m: tuple[float, float] | None, rng: np.random.Generator
) -> Array:
    """(4, 4) a start within the network's range: per axis a rotation and a shift of random sign."""
    rotation_deg, translation_m = range_deg_m or _DEFAULT_RANGE
    signs = rng.choice([-1.0, 1.0], 6)
    turn = Rotation.from_rotvec(_SHARE_OF_RANGE * rotation_deg * signs[:3], degrees=True)
    D = transform(turn, _SHARE_OF_RANGE * translation_m * signs[3:])
    return np.asarray(D @ T_camera_lidar)


def remaining_share(
    camera: Camera, T_base: Array, T_displaced: Array, matches: Correspondences
) -> float:
    """Share of a displacement that remains in the matches found from it.

    Args:
        camera: with its lens.
        T_base: (4, 4) T_camera_lidar estimated by the network before.
        T_displaced: (4, 4) T_camera_lidar from which the matches were found.
        matches: of one frame.

    Returns:
        Slope of the matches' displacement over the start's, both in pixels from the base: 0 if
        the matches are independent of the start, 1 if they follow it; NaN with too few matches.
    """
    points = matches.points_lidar_m
    base, start = (camera.lens.project(points, T)[0] for T in (T_base, T_displaced))
    displacement, remainder = start - base, matches.pixels_px - base
    if len(points) < _MIN_POINTS:
        return float("nan")
    return float((remainder * displacement).sum() / (displacement**2).sum())
