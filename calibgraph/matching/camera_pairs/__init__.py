"""Camera-to-camera matches: co-visible features on the LiDAR's surfaces."""

from calibgraph.matching.camera_pairs.find import match_cameras, match_some_frames, with_surfaces
from calibgraph.matching.camera_pairs.overlap import overlapping_pairs

__all__ = ["match_cameras", "match_some_frames", "overlapping_pairs", "with_surfaces"]
