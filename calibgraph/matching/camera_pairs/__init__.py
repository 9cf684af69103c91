"""Camera-camera matches: what the cameras of a rig see in common, with the LiDAR's ranges."""

from calibgraph.matching.camera_pairs.find import match_cameras, with_ranges

__all__ = ["match_cameras", "with_ranges"]
