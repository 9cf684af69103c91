"""Camera-camera matches: what the cameras of a rig see in common, on the LiDAR's surfaces."""

from calibgraph.matching.camera_pairs.find import match_cameras, with_surfaces

__all__ = ["match_cameras", "with_surfaces"]
