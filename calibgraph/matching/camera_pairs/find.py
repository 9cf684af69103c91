"""Camera-camera matches of a dataset: features, epipolar geometry, surfaces of the LiDAR.

Features are SIFT keypoints and descriptors, with the rays of the keypoints.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.matching.camera_pairs.geometry import agree_on_epipolar_geometry, planes_at
from calibgraph.model.camera_matches import CameraMatches, concatenate_camera_matches
from calibgraph.model.clock import when_taken
from calibgraph.model.geometry import planes_in_lidar
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import core_pool
from calibgraph.progress import Progress, no_progress
from factors import unproject

Pair = tuple[str, str]
_MARGIN = 0.1  # of an image's size, added on each side: extrinsics are estimates
_POINTS = 5000  # of the cloud: a common strip of a hundredth of all it sees still has 50
PAIR_FRAMES = 3
"""So many frames of a recording are enough: on KITTI, 2 to 10 give relative poses within 0.01 deg
and 0.3 cm of each other, and 3 take a tenth of the time of a run."""


def match_cameras(
    dataset: Dataset,
    rig: Rig,
    pairs: Iterable[Pair] | None = None,
    *,
    most_frames: int | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> CameraMatches:
    """Find features that two cameras of a rig see at one instant, without their extrinsics.

    Matches of all frames of a pair have to agree on one epipolar geometry. A pair that sees
    nothing in common has no matches.

    Args:
        dataset: images.
        rig: lenses.
        pairs: of cameras, A before B in the rig's order; all of them if None.
        most_frames: so many, evenly spread; a calibration takes ``PAIR_FRAMES``; None: all.
        seed: of the choice of samples.
        progress: called as frames are done.

    Returns:
        Matches without surfaces; see :func:`with_surfaces`.

    Raises:
        FileError: if an image cannot be read.
    """
    wanted = list(combinations(rig.cameras, 2)) if pairs is None else list(pairs)
    chosen = dataset.frames if most_frames is None else spread_out(dataset.frames, most_frames)
    found: dict[Pair, list[tuple[int, Features, Features]]] = {pair: [] for pair in wanted}
    match = partial(_match_frame, rig=rig, pairs=wanted)
    with core_pool() as cores:
        for done, (frame, matches) in enumerate(zip(chosen, cores.map(match, chosen), strict=True)):
            progress("matching cameras", done, len(chosen))
            for pair, both in matches.items():
                found[pair].append((frame.index, *both))
    tables = [_agreeing(rig, pair, parts, seed) for pair, parts in found.items() if parts]
    metadata = {"camera_features": "sift", "seed": seed}
    return concatenate_camera_matches([CameraMatches.empty(tuple(rig.cameras), metadata), *tables])


def _match_frame(
    frame: Frame, *, rig: Rig, pairs: Sequence[Pair]
) -> dict[Pair, tuple[Features, Features]]:
    """Per pair of cameras with images in a frame, the matched features of both."""
    seen = [pair for pair in pairs if frame.image_paths.keys() >= set(pair)]
    features = {
        name: features_of(frame, name, camera)
        for name, camera in rig.cameras.items()
        if any(name in pair for pair in seen)
    }
    matches = {}
    for a, b in seen:
        rows = match_features(features[a], features[b])
        matches[a, b] = features[a][rows[:, 0]], features[b][rows[:, 1]]
    return matches


def with_surfaces(table: CameraMatches, dataset: Dataset, rig: Rig) -> CameraMatches:
    """The same matches with the LiDAR's surfaces next to them, under the rig's extrinsics.

    The surfaces are in the LiDAR frame when the image is taken, at the offset of the rig.

    Args:
        table: of any pairs and frames.
        dataset: clouds.
        rig: its extrinsics place the clouds in the cameras' frames.

    Raises:
        FileError: if a cloud cannot be read.
    """
    planes = np.full((len(table), 2, 3), np.nan)
    seen = [frame for frame in dataset.frames if (table.frame == frame.index).any()]
    with core_pool() as cores:
        for rows, found in cores.map(partial(_planes_of_frame, table=table, rig=rig), seen):
            planes[rows] = found
    return replace(table, planes_lidar_per_m=planes)


def _planes_of_frame(
    frame: Frame, *, table: CameraMatches, rig: Rig
) -> tuple[NDArray[np.intp], Array]:
    """The table's rows of a frame, and (m, 2, 3) planes at their features."""
    of_frame = np.flatnonzero(table.frame == frame.index)
    cloud = frame.load_cloud()[:, :3].astype(np.float64)
    planes = np.full((len(of_frame), 2, 3), np.nan)
    for index, name in enumerate(table.cameras):
        rows, sides = np.nonzero(table.camera_index[of_frame] == index)
        if len(rows):
            camera = rig.cameras[name]
            rays = unproject(camera.lens, table.pixels_px[of_frame[rows], sides])[0]
            T = when_taken(camera, frame.twist_per_s).T_camera_lidar
            in_camera = planes_at(rays, cloud @ T[:3, :3].T + T[:3, 3])
            planes[rows, sides] = planes_in_lidar(in_camera, camera.T_camera_lidar)
    return of_frame, planes


def _agreeing(
    rig: Rig, pair: Pair, parts: Sequence[tuple[int, Features, Features]], seed: int
) -> CameraMatches:
    """The matches of a pair that agree on an epipolar geometry, over all its frames."""
    cameras = tuple(rig.cameras)
    a, b = (rig.cameras[name] for name in pair)
    frames, *sides = zip(*parts, strict=True)
    both = [np.concatenate(side) for side in sides]
    agrees = agree_on_epipolar_geometry(a, b, both[0]["ray"], both[1]["ray"], seed=seed)
    frame = np.repeat(frames, [len(one) for one in sides[0]])
    n = int(np.count_nonzero(agrees))
    numbers = np.array([cameras.index(name) for name in pair], np.int32)
    return CameraMatches(
        cameras=cameras,
        camera_index=np.tile(numbers, (n, 1)),
        frame=frame[agrees].astype(np.int64),
        pixels_px=np.stack([side["pixel_px"] for side in both], axis=1)[agrees],
        planes_lidar_per_m=np.full((n, 2, 3), np.nan),
    )


def overlapping_pairs(rig: Rig, cloud: NDArray[np.float32]) -> list[tuple[str, str]]:
    """The pairs of cameras that have points of a cloud in both images, or next to them.

    Args:
        rig: lenses and extrinsics.
        cloud: (n, >= 3) x y z [m] in the LiDAR frame.

    Returns:
        A before B in the rig's order.
    """
    step = max(1, len(cloud) // _POINTS)
    points = cloud[::step, :3].astype(np.float64)
    seen = {name: _in_widened_image(camera, points) for name, camera in rig.cameras.items()}
    return [(a, b) for a, b in combinations(rig.cameras, 2) if (seen[a] & seen[b]).any()]


def _in_widened_image(camera: Camera, points: Array) -> NDArray[np.bool_]:
    """(n,) the points that project into the image or its margin."""
    pixels, valid = camera.lens.project(points, camera.T_camera_lidar)
    size = np.array([camera.width_px, camera.height_px])
    shares = (pixels + 0.5) / size
    return np.asarray(valid & (shares > -_MARGIN).all(axis=1) & (shares < 1 + _MARGIN).all(axis=1))


Gray = NDArray[np.uint8]

MAX_SIDE_PX = 800
"""Larger images are reduced. On KITTI, relative poses are as good as with all pixels, in a third of
the time; on images of 1600 to 1936 px there are as many matches or more. A search, and the motion
of the vehicle, would do with less, but find the features of some frames there."""
MAX_FEATURES = 4000  # per image
LOWE_RATIO = 0.8  # of the distances of the best and the second best match, at most


FEATURE = np.dtype([("pixel_px", "f8", 2), ("ray", "f8", 3), ("descriptor", "f4", 128)])
"""A feature of an image: column and row, the unit viewing ray in the camera frame, and SIFT's."""
Features = NDArray[np.void]
"""(n,) of FEATURE."""


def features_of(frame: Frame, name: str, camera: Camera) -> Features:
    """The features of a camera's image of a frame, see :func:`detect_features`.

    Raises:
        FileError: if the image cannot be read.
    """
    lens = camera.lens
    return frame.derive(
        ("features", name, lens.kind, lens.packed.tobytes()),
        lambda: detect_features(frame.load_gray(name, camera), camera),
    )


def detect_features(gray: Gray, camera: Camera) -> Features:
    """SIFT features of an image that lie on rays of the lens, one per place."""
    factor = min(1.0, MAX_SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # Without the precise upscaling, keypoints are off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(small, None)
    if not points:
        return np.empty(0, FEATURE)
    scale = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
    pixels = (np.array([point.pt for point in points]) + 0.5) * scale - 0.5
    # A keypoint with several orientations comes several times; they are no independent matches.
    rows = np.sort(np.unique(pixels.round(2), axis=0, return_index=True)[1])
    rays, valid = unproject(camera.lens, pixels[rows])
    found = np.empty(np.count_nonzero(valid), FEATURE)
    found["pixel_px"], found["ray"] = pixels[rows[valid]], rays[valid]
    found["descriptor"] = descriptors[rows[valid]]
    return found


def match_features(a: Features, b: Features) -> NDArray[np.intp]:
    """(m, 2) rows of the features of A and B that are each other's best match, clearly.

    Clearly: the second best of B is farther from A's feature by the ratio of Lowe (2004).
    """
    if min(len(a), len(b)) < 2:  # noqa: PLR2004
        return np.empty((0, 2), np.intp)
    unit = [each / np.linalg.norm(each, axis=1, keepdims=True)
            for each in (a["descriptor"], b["descriptor"])]  # fmt: skip
    cosine = unit[0] @ unit[1].T
    rows, best = np.arange(len(cosine)), cosine.argmax(axis=1)
    first, of_b = cosine[rows, best].copy(), cosine.max(axis=0)
    cosine[rows, best] = -1.0
    second = cosine.max(axis=1)
    clear = 1.0 - first < LOWE_RATIO**2 * (1.0 - second)  # half the squares of the distances
    kept = np.flatnonzero(clear & (of_b[best] == first))
    kept = kept[np.sort(np.unique(best[kept], return_index=True)[1])]  # the first of the same
    return np.column_stack([kept, best[kept]])
