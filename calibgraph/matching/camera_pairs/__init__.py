"""Camera-camera matches: what the cameras of a rig see in common, on the LiDAR's surfaces."""

from calibgraph.matching.camera_pairs.find import match_cameras, with_surfaces
from calibgraph.matching.camera_pairs.overlap import overlapping_pairs

__all__ = ["match_cameras", "overlapping_pairs", "with_surfaces"]
