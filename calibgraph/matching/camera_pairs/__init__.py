"""Camera-to-camera matches: co-visible features on the LiDAR's surfaces."""

from calibgraph.matching.camera_pairs.find import (
    PAIR_FRAMES,
    match_cameras,
    overlapping_pairs,
    with_surfaces,
)

__all__ = ["PAIR_FRAMES", "match_cameras", "overlapping_pairs", "with_surfaces"]
