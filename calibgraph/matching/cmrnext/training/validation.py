"""Validation of a network in training on held-out frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.dataset import spread_out
from calibgraph.matching.cmrnext.training.samples import Sample, Scene, make_sample
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.pnp import frame_pose

MAX_SCENES = 100
"""Most images to validate on, evenly spread over those held out: they are kept in memory."""


@dataclass(frozen=True)
class Validation:
    """Errors of a network on held-out frames.

    Attributes:
        step: of the training.
        train_loss: mean since the last validation.
        epe_px: mean length of the flow's error, full-resolution pixels.
        median_px: its median.
        zero_px: mean length of the true flow: the error of a network that predicts zero.
        pose_deg, pose_cm: median error of a single frame's pose, by PnP.
        start_deg, start_cm: median error of the perturbed start.
        failed_share: share of the frames without a pose.
        systematic_rotation_rad, systematic_translation_m: error per axis that the frames of a
            camera share; the matcher reports it, for the covariance.
    """

    step: int
    train_loss: float
    epe_px: float
    median_px: float
    zero_px: float
    pose_deg: float
    pose_cm: float
    start_deg: float
    start_cm: float
    failed_share: float
    systematic_rotation_rad: float
    systematic_translation_m: float


def make_validation_samples(
    held_out: Sequence[Scene], settings: TrainSettings
) -> list[tuple[Scene, Sample]]:
    """At most ``MAX_SCENES`` perturbed scenes; the same at every call.

    Raises:
        DatasetError: if none shows enough points.
    """
    rng = np.random.default_rng([settings.seed, 2**31])
    made = [
        (scene, make_sample(scene, settings, rng, augment=False))
        for scene in spread_out(held_out, MAX_SCENES)
    ]
    samples = [(scene, sample) for scene, sample in made if sample is not None]
    if not samples:
        raise DatasetError("no held-out frame shows enough points in the image")
    return samples


def pose_error(scene: Scene, sample: Sample, flow_px: NDArray[np.float32]) -> Array | None:
    """(6,) rotation [rad] and translation [m] of a frame's pose against the truth, or None."""
    if not np.isfinite(flow_px).all():
        return None
    camera = scene.camera.model_copy(update={"model": "pinhole", "distortion": ()})
    matches = Correspondences.from_arrays(
        camera="camera",
        frame=0,
        pixels_px=sample.pixels_px + flow_px,
        points_lidar_m=sample.points_camera_m,
    )
    T = frame_pose(camera, matches, Config())
    return None if T is None else _twist(T)


def _twist(T: Array) -> Array:
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])


def summarize_poses(
    samples: Sequence[tuple[Scene, Sample]], poses: list[Array | None], settings: TrainSettings
) -> dict[str, float]:
    """The members of a :class:`Validation` that concern poses."""
    starts = np.array([_twist(sample.E) for _, sample in samples])
    solved = [pose for pose in poses if pose is not None]
    errors = np.array(solved or [np.full(6, np.nan)])
    cameras: dict[str, list[Array]] = {}
    for (scene, _), pose in zip(samples, poses, strict=True):
        if pose is not None:
            cameras.setdefault(f"{scene.name} {scene.camera.intrinsics_px}", []).append(pose)
    shared = np.array([np.mean(each, axis=0) for each in cameras.values()] or [
        [math.radians(settings.rotation_deg)] * 3 + [settings.translation_m] * 3
    ])  # fmt: skip
    return {
        "pose_deg": float(np.degrees(np.median(np.linalg.norm(errors[:, :3], axis=1)))),
        "pose_cm": float(100 * np.median(np.linalg.norm(errors[:, 3:], axis=1))),
        "start_deg": float(np.degrees(np.median(np.linalg.norm(starts[:, :3], axis=1)))),
        "start_cm": float(100 * np.median(np.linalg.norm(starts[:, 3:], axis=1))),
        "failed_share": 1 - len(solved) / len(poses),
        "systematic_rotation_rad": float(np.sqrt(np.mean(shared[:, :3] ** 2))),
        "systematic_translation_m": float(np.sqrt(np.mean(shared[:, 3:] ** 2))),
    }
