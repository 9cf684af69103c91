"""Camera-camera matches of a dataset: features, epipolar geometry, surfaces of the LiDAR."""

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.matching.camera_pairs.features import Features, features_of, match_features
from calibgraph.matching.camera_pairs.geometry import agree_on_epipolar_geometry
from calibgraph.matching.camera_pairs.surfaces import planes_at
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
        matches[a, b] = features[a].select(rows[:, 0]), features[b].select(rows[:, 1])
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
    return table.with_planes(planes)


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
    T = camera.T_camera_lidar
    pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    size = np.array([camera.width_px, camera.height_px])
    shares = (pixels + 0.5) / size
    return np.asarray(valid & (shares > -_MARGIN).all(axis=1) & (shares < 1 + _MARGIN).all(axis=1))
