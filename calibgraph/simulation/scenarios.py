"""Named scenarios of correspondences: a rig, and the errors of its matcher."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from calibgraph.file_sets import require_own_folder
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.metrics import perturb
from calibgraph.model.rig import Rig
from calibgraph.simulation.correspondences import (
    MatcherErrors,
    PoseSpread,
    simulate_correspondences,
)
from calibgraph.simulation.rigs import rig_of

MAX_FRAMES = 10_000
MATCHES = 1000  # per camera and frame: the paper's grid keeps at most as many


@dataclass(frozen=True, eq=False)
class Scenario:
    """A rig in a street, and a matcher."""

    rig: Rig
    errors: Mapping[str, MatcherErrors]

    def draw(self, frames: int, seed: int) -> Correspondences:
        """Draw the correspondences of a drive."""
        return simulate_correspondences(
            self.rig, frames=frames, matches=MATCHES, errors=self.errors, depth_m=None, seed=seed
        )


def simulate_table(
    out: Path, name: str, *, frames: int, rotation_deg: float, translation_m: float, seed: int
) -> list[Path]:
    """Write the correspondences of a scenario with its truth and a guess.

    Returns:
        The files.

    Raises:
        ValueError: if there is no such scenario, or an argument is out of range.
        FileError: if the folder holds files.
    """
    scenario = scenario_of(name)
    if not 1 <= frames <= MAX_FRAMES:
        raise ValueError(f"{frames} frames: expected 1 to {MAX_FRAMES}")
    guess = perturb(scenario.rig, rotation_deg=rotation_deg, translation_m=translation_m, seed=seed)
    require_own_folder(out)
    paths = [out / name for name in ("correspondences.parquet", "reference.yaml", "rig.yaml")]
    scenario.draw(frames, seed).save(paths[0])
    scenario.rig.save(paths[1])
    guess.save(paths[2])
    return paths


def scenario_of(name: str) -> Scenario:
    """A scenario by name.

    ``kitti`` and ``walkley`` resemble the paper's Stage-1 results (``benchmarks/notes/paper.md``):
    errors along the axes that most frames share, and confidences that are high or informative.

    Raises:
        ValueError: if there is no such scenario.
    """
    if name not in SCENARIOS:
        raise ValueError(f"unknown scenario {name!r}; known are street, {', '.join(SCENARIOS)}")
    rig, errors = rig_of(name), _ERRORS[name]
    per_camera = {camera: errors for camera in rig.cameras}
    if name == "kitti":
        per_camera["image_3"] = replace(errors, bias_pose=_KITTI_RIGHT)
    return Scenario(rig, per_camera)


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
