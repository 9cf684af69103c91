"""Named scenarios of correspondences: a rig, and the errors of its matcher."""

from dataclasses import replace

from calibgraph.model.correspondences import Correspondences
from calibgraph.simulation.correspondences import (
    MatcherErrors,
    PoseSpread,
    simulate_correspondences,
)
from calibgraph.simulation.rigs import rig_of

MATCHES = 1000  # per camera and frame: the paper's grid keeps at most as many


def draw_scenario(name: str, frames: int, seed: int) -> Correspondences:
    """The correspondences of a drive along a street, of the rig of this name.

    ``kitti`` and ``walkley`` resemble the paper's Stage-1 results (``benchmarks/notes/paper.md``):
    errors along the axes that most frames share, and confidences that are high or informative.
    """
    rig, errors = rig_of(name), _ERRORS[name]
    per_camera = dict.fromkeys(rig.cameras, errors)
    if name == "kitti":
        per_camera["image_3"] = replace(errors, bias_pose=_KITTI_RIGHT)
    return simulate_correspondences(
        rig, frames=frames, matches=MATCHES, errors=per_camera, depth_m=None, seed=seed
    )


_KITTI_RIGHT = PoseSpread(translation_m=(0.06, 0.005, 0.005))
_ERRORS = {
    "kitti": MatcherErrors(
        noise_px=0.4,
        noise_spread=0.3,
        frame_noise_px=0.2,
        field_px=0.3,
        frame_spread=0.3,
        stuck_share=0.66,
        stuck_pose=PoseSpread((0.2, 0.22, 0.13), (0.07, 0.02, 0.015)),
        outlier_share=0.05,
        informative_confidence=False,
    ),
    "walkley": MatcherErrors(
        noise_px=2.5,
        noise_spread=0.5,
        frame_noise_px=1.5,
        field_px=2.5,
        frame_spread=0.4,
        stuck_share=0.75,
        stuck_pose=PoseSpread((0.7, 1.4, 0.6), (0.5, 0.3, 1.75)),
        stuck_scatter=0.4,
        outlier_share=0.3,
        failed_share=0.03,
    ),
}
SCENARIOS = tuple(_ERRORS)
