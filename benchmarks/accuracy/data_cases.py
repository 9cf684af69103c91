"""Recorded and simulated data that are good, or wrong in one of many ways: see ``verdicts``."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.accuracy import image_cases
from benchmarks.accuracy.rig_changes import (
    Rng,
    compose_extrinsics,
    derangement,
    invert_extrinsics,
    random_offset,
    random_sign,
    to_transform,
    with_focal,
    with_focal_y,
    with_principal_point,
    with_stereo,
)
from benchmarks.accuracy.scenes import (
    FEW_FRAMES,
    MOTORWAY,
    ONE_CAMERA,
    Case,
    Folders,
    Scene,
    with_clouds,
    with_images,
)
from benchmarks.accuracy.worlds import Problem
from calibgraph import Frame, calibrate


def good(scene: Scene, rng: Rng) -> Case:
    """Nothing is wrong."""
    return scene.data, scene.guess(), {}


def few_frames(scene: Scene, rng: Rng) -> Case:
    """Two to four frames of one place."""
    count = min(int(rng.integers(2, 5)), len(scene.data.frames))
    start = int(rng.integers(len(scene.data.frames) - count + 1))
    return scene.data.select(f"{start}:{start + count}"), scene.guess(), {"few": count}


def far(scene: Scene, rng: Rng) -> Case:
    """The guess is beyond the matcher's range."""
    deg, m = rng.uniform(6, 20), rng.uniform(0.5, 1.5)
    return scene.data, scene.guess(deg, m), {"guess_deg": deg, "guess_m": m}


def far_turned(scene: Scene, rng: Rng) -> Case:
    """All guesses are beyond the matcher's range by one displacement, that of the LiDAR."""
    deg, m = rng.uniform(6, 20), rng.uniform(0.5, 1.5)
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    step = to_transform(deg * axis, m * way)
    return scene.data, compose_extrinsics(scene.guess(), step), {"guess_deg": deg, "guess_m": m}


def swapped(scene: Scene, rng: Rng, known: bool) -> Case:
    """Two cameras' images are swapped; their relative pose may be known."""
    a, b = scene.pair
    swap = {a: b, b: a}

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        return {name: frame.image_paths[swap.get(name, name)] for name in frame.image_paths}

    guess = scene.guess()
    guess = with_stereo(guess, scene.truth, a, b) if known else guess
    return with_images(scene.data, paths), guess, {}


def shuffled(scene: Scene, rng: Rng) -> Case:
    """Images are of other frames than the clouds."""
    frames = scene.data.frames
    order = derangement(len(frames), rng)
    return (
        with_images(scene.data, lambda i, frame: frames[order[i]].image_paths),
        scene.guess(),
        {"order": order.tolist()},
    )


def shifted(scene: Scene, rng: Rng) -> Case:
    """Images are of the next frame of the same sequence."""
    frames = scene.data.frames
    pairs = [
        replace(frame, image_paths=after.image_paths)
        for frame, after in zip(frames[:-1], frames[1:], strict=True)
        if frame.cloud_path.parent == after.cloud_path.parent
    ]
    return replace(scene.data, frames=tuple(pairs)), scene.guess(), {}


def focal(scene: Scene, rng: Rng, share: float) -> Case:
    """The rig's focal lengths are wrong."""
    factor = 1 + random_sign(rng) * share
    return scene.data, with_focal(scene.guess(), factor), {"factor": factor}


def focal_y(scene: Scene, rng: Rng) -> Case:
    """The rig's fy alone is 3 to 5 % wrong."""
    factor = 1 + random_sign(rng) * rng.uniform(0.03, 0.05)
    return scene.data, with_focal_y(scene.guess(), factor), {"factor": factor}


def principal(scene: Scene, rng: Rng) -> Case:
    """The rig's principal points are wrong by 15 to 40 px."""
    offset_px = random_offset(rng, 15, 40)
    guess = with_principal_point(scene.guess(), offset_px)
    return scene.data, guess, {"offset_px": offset_px.tolist()}


def mirrored(scene: Scene, rng: Rng) -> Case:
    """The clouds are mirrored: y is -y."""
    return with_clouds(scene, lambda cloud: cloud * [1, -1, 1, 1]), scene.guess(), {}


def wrong_units(scene: Scene, rng: Rng) -> Case:
    """The clouds are in millimetres."""
    return with_clouds(scene, lambda cloud: cloud * [1000, 1000, 1000, 1]), scene.guess(), {}


def other(scene: Scene, rng: Rng) -> Case:
    """The images are of another place."""
    images = scene.folders.images_for(scene.name).frames
    start = len(images) // 2  # also of its own images, if there is no other place

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        return images[(index + start) % len(images)].image_paths

    return with_images(scene.data, paths), scene.guess(), {}


def covered(scene: Scene, rng: Rng, blurred: bool) -> Case:
    """One camera's images are black, or blurred beyond use."""
    name = str(rng.choice(list(scene.truth.cameras)))

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        image = frame.load_image(name, scene.truth.cameras[name])
        changed = cv2.GaussianBlur(image, (0, 0), 40) if blurred else np.zeros_like(image)
        path = scene.scratch / f"{index:06d}.png"
        cv2.imwrite(str(path), changed)
        return {**frame.image_paths, name: path}

    return with_images(scene.data, paths), scene.guess(), {"covered": name}


def inverted_guess(scene: Scene, rng: Rng) -> Case:
    """The guess is T_lidar_camera."""
    return scene.data, invert_extrinsics(scene.guess()), {}


KINDS: dict[str, Callable[[Scene, Rng], Case]] = {
    "good": good,
    "motorway": good,
    "few_frames": few_frames,
    "far": far,
    "far_turned": far_turned,
    "swapped": partial(swapped, known=True),
    "swapped_unknown": partial(swapped, known=False),
    "shuffled": shuffled,
    "shifted": shifted,
    "focal_5": partial(focal, share=0.05),
    "focal_3": partial(focal, share=0.03),
    "focal_y": focal_y,
    "principal": principal,
    "mirrored": mirrored,
    "other": other,
    "covered": partial(covered, blurred=False),
    "blurred": partial(covered, blurred=True),
    "wrong_units": wrong_units,
    "inverted": inverted_guess,
    **image_cases.KINDS,
}

BETWEEN_CAMERAS = ("swapped", "swapped_unknown", "distant_swap")
BETWEEN_FRAMES = ("shuffled", "shifted", "moved_halfway", "frozen", "few_frames")
"""Kinds that need two cameras, and three frames."""
UNDETECTABLE = ("scaled",)
"""A wrong scale of all distances looks like another place of the camera: not counted."""


def data_for(kind: str, names: list[str], seed: int) -> str | None:
    """The name of a case's data, or None if there is none."""
    if kind == "motorway":
        return MOTORWAY
    lacking = (ONE_CAMERA if kind in BETWEEN_CAMERAS else ()) + (
        FEW_FRAMES if kind in BETWEEN_FRAMES else ()
    )
    fit = [name for name in names if name not in lacking]
    return fit[(seed + zlib.crc32(kind.encode())) % len(fit)] if fit else None


def data_problem(kind: str, name: str, seed: int, folders: Folders, scratch: Path) -> Problem:
    """One case.

    Args:
        kind: one of KINDS.
        name: of the data.
        seed: of all that is drawn.
        folders: where the data are.
        scratch: an empty folder, to be removed after the case has run.
    """
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    data, truth = folders.load(name)
    scene = Scene(name, data, truth, folders, scratch, int(rng.integers(2**31)))
    spoilt, guess, drawn = KINDS[kind](scene, rng)
    drawn = {"frames": len(spoilt.frames), **drawn}
    return Problem(truth=truth, calibrate=lambda: calibrate(spoilt, guess), drawn=drawn)
