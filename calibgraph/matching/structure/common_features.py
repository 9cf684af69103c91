"""Co-visible features of a rig's cameras in the frames of a search, and the poses they imply."""

from collections.abc import Mapping

import numpy as np

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset
from calibgraph.matching.camera_pairs import match_cameras
from calibgraph.matching.camera_pairs.geometry import points_at, relative_pose
from calibgraph.matching.structure.pose_refinement import CameraFrames
from calibgraph.model.rig import Rig
from factors import unproject

FRAMES = 4


class CommonFeatures:
    """Features that pairs of cameras see in common."""

    def __init__(self, rig: Rig, frames: Mapping[str, CameraFrames], *, seed: int) -> None:
        self._rig, self._seed, of_any = rig, seed, next(iter(frames.values()))
        numbers = [frame.index for frame in of_any.frames]
        self._clouds = dict(zip(numbers, of_any.clouds, strict=True))
        data = Dataset(rig=rig, frames=tuple(of_any.frames), folders=())
        self._matches = match_cameras(data, rig, most_frames=FRAMES, seed=seed)

    def place(self, name: str, other: str, T_other_lidar: Array) -> Array | None:
        """(4, 4) T_camera_lidar of a camera from where another one is.

        The clouds give the depths of the features, in the frame of the other camera.

        Returns:
            None if too little is seen in common.
        """
        found = self._matches.of_pair(name, other), self._matches.of_pair(other, name)
        of_name = 0 if len(found[0]) else 1
        both, points, rays = found[of_name], [], []
        for number in np.unique(both.frame).tolist():
            pixels = both.pixels_px[both.frame == number]
            seen_by_this, seen_by_other = (
                unproject(self._rig.cameras[camera].lens, pixels[:, side])[0]
                for camera, side in ((name, of_name), (other, 1 - of_name))
            )
            cloud = self._clouds[number].points_lidar_m
            in_other_m = cloud @ T_other_lidar[:3, :3].T + T_other_lidar[:3, 3]
            near, met = points_at(seen_by_other, in_other_m)
            points.append(met)
            rays.append(seen_by_this[near])
        if not rays:
            return None
        T_this_other = relative_pose(np.concatenate(points), np.concatenate(rays), seed=self._seed)
        return None if T_this_other is None else T_this_other @ T_other_lidar
