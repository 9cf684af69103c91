"""Camera-camera matches of a dataset: features, epipolar geometry, surfaces of the LiDAR."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset
from calibgraph.matching.camera_pairs.features import Features, detect_features, match_features
from calibgraph.matching.camera_pairs.geometry import agree_on_epipolar_geometry
from calibgraph.matching.camera_pairs.surfaces import planes_at
from calibgraph.model.camera_matches import CameraMatches, concatenate_camera_matches
from calibgraph.model.geometry import planes_in_lidar
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, no_progress
from factors import unproject

Array = NDArray[np.float64]
Pair = tuple[str, str]


def match_cameras(
    dataset: Dataset,
    rig: Rig,
    *,
    pairs: Iterable[Pair] | None = None,
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
        seed: of the choice of samples.
        progress: called with the stage, its steps done, and their number.

    Returns:
        Matches without surfaces; see :func:`with_surfaces`.

    Raises:
        FileError: if an image cannot be read.
    """
    wanted = list(combinations(rig.cameras, 2)) if pairs is None else list(pairs)
    found: dict[Pair, list[tuple[int, Features, Features]]] = {pair: [] for pair in wanted}
    for done, frame in enumerate(dataset.frames):
        progress("matching cameras", done, len(dataset.frames))
        names = {name for pair in wanted for name in pair} & frame.image_paths.keys()
        features = {
            name: detect_features(frame.load_gray(name, camera), camera)
            for name, camera in rig.cameras.items()
            if name in names
        }
        for pair in wanted:
            if names.issuperset(pair):
                both = features[pair[0]], features[pair[1]]
                rows = match_features(*both)
                a, b = (side.select(rows[:, k]) for k, side in enumerate(both))
                found[pair].append((frame.index, a, b))
    tables = [_agreeing(rig, pair, parts, seed) for pair, parts in found.items() if parts]
    metadata = {"camera_features": "sift", "seed": seed}
    return concatenate_camera_matches([CameraMatches.empty(tuple(rig.cameras), metadata), *tables])


def with_surfaces(table: CameraMatches, dataset: Dataset, rig: Rig) -> CameraMatches:
    """The same matches with the LiDAR's surfaces next to them, under the rig's extrinsics.

    Args:
        table: of any pairs and frames.
        dataset: clouds.
        rig: its extrinsics place the clouds in the cameras' frames.

    Raises:
        FileError: if a cloud cannot be read.
    """
    planes = np.full((len(table), 2, 3), np.nan)
    for frame in dataset.frames:
        in_frame = (table.frame == frame.index)[:, None]
        if not in_frame.any():
            continue
        cloud = frame.load_cloud()[:, :3].astype(np.float64)
        for index, name in enumerate(table.cameras):
            rows, sides = np.nonzero(in_frame & (table.camera_index == index))
            if len(rows):
                camera = rig.cameras[name]
                rays = unproject(camera.lens, table.pixels_px[rows, sides])[0]
                T = camera.T_camera_lidar
                in_camera = planes_at(rays, cloud @ T[:3, :3].T + T[:3, 3])
                planes[rows, sides] = planes_in_lidar(in_camera, T)
    return table.with_planes(planes)


def _agreeing(
    rig: Rig, pair: Pair, parts: Sequence[tuple[int, Features, Features]], seed: int
) -> CameraMatches:
    """The matches of a pair that agree on an epipolar geometry, over all its frames."""
    cameras = tuple(rig.cameras)
    a, b = (rig.cameras[name] for name in pair)
    sides = [[part[1] for part in parts], [part[2] for part in parts]]
    rays = [np.concatenate([features.rays for features in side]) for side in sides]
    fit = agree_on_epipolar_geometry(a, b, *rays, seed=seed)
    pixels = [np.concatenate([features.pixels_px for features in side]) for side in sides]
    frame = np.concatenate([np.full(len(one.rays), index) for index, one, _ in parts])
    n = int(np.count_nonzero(fit.inlier))
    numbers = np.array([cameras.index(name) for name in pair], np.int32)
    return CameraMatches(
        cameras=cameras,
        camera_index=np.tile(numbers, (n, 1)),
        frame=frame[fit.inlier].astype(np.int64),
        pixels_px=np.stack(pixels, axis=1)[fit.inlier],
        planes_lidar_per_m=np.full((n, 2, 3), np.nan),
    )
