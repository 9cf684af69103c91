"""The global search: the poses near a guess at which one camera's responses agree best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from calibgraph.matching.structure.correlation_maps import Responses
from calibgraph.matching.structure.cross_entropy import maximize
from calibgraph.model.geometry import relative_transform

Array = NDArray[np.float64]

COARSE_BLUR_STEPS, COARSE_EVERY, FINE_BLUR_STEPS = 2.0, 2, 1.0
SAMPLES = 2048  # of the range; each is turned to the right, and a little down, to where it is best
TURN_DOWN_RAD = np.radians(6.0)  # a turn down is nearly a shift of the maps within so much
SEEDS, SHARPENED, CANDIDATES = 24, 16, 10  # how many go on from each stage
APART = np.repeat([np.radians(3.0), 0.6], 3)  # nearer poses are the same
COARSE_SPREAD = np.repeat([np.radians(1.5), 0.3], 3)
FINE_SPREAD = np.repeat([np.radians(0.8), 0.15], 3)
REACH = 2.5  # spreads
CLIMB_SAMPLES, CLIMB_STEPS = 60, 6
PENALTY = 10.0  # contrasts, per half-width outside of the range


@dataclass(frozen=True, eq=False)
class Box:
    """The poses T_delta guess, with T_delta within a range per axis.

    Attributes:
        guess: (4, 4) T_camera_lidar.
        rotation_rad, translation_m: half-widths, per axis of the camera.
    """

    guess: Array
    rotation_rad: float
    translation_m: float

    @property
    def half_widths(self) -> Array:
        """(6,)."""
        return np.repeat([self.rotation_rad, self.translation_m], 3)

    def poses(self, displacements: Array) -> Array:
        """(n, 4, 4) T_camera_lidar of displacements (n, 6): rotation vector [rad], shift [m]."""
        T = np.zeros((len(displacements), 4, 4))
        T[:, 3, 3] = 1.0
        T[:, :3, :3] = Rotation.from_rotvec(displacements[:, :3]).as_matrix()
        T[:, :3, 3] = displacements[:, 3:]
        return np.asarray(T @ self.guess)

    def displacement(self, T_camera_lidar: Array) -> Array:
        """(6,) the displacement that leads to a pose."""
        T = relative_transform(T_camera_lidar, self.guess)
        return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])

    def excess(self, displacements: Array) -> Array:
        """(n,) how far they are outside, in half-widths, summed over the axes."""
        return np.asarray(np.maximum(np.abs(displacements) / self.half_widths - 1, 0).sum(axis=1))


def search_box(responses: Responses, box: Box, *, effort: int = 1, seed: int) -> list[Array]:
    """The best poses in a box, T_camera_lidar (4, 4), best first, none near to another.

    Args:
        responses: of one camera.
        box: where to search.
        effort: how many times as many of the best go on from each stage.
        seed: of the search.
    """
    coarse = responses.blurred(COARSE_BLUR_STEPS, COARSE_EVERY)
    rng = np.random.default_rng(seed)
    seeds = _apart(_turned(coarse, box, rng), effort * SEEDS)
    rough = _climbed(coarse, box, seeds, COARSE_SPREAD, rng)[: effort * SHARPENED]
    fine = responses.blurred(FINE_BLUR_STEPS)
    sharp = _apart(_climbed(fine, box, rough, FINE_SPREAD, rng), effort * CANDIDATES)
    return list(box.poses(np.array(sharp)))


def _turned(coarse: Responses, box: Box, rng: np.random.Generator) -> list[Array]:
    """Samples of the box, each turned to where it is best; best first."""
    unit = qmc.Sobol(6, seed=rng).random(SAMPLES)
    displacements = (2 * unit - 1) * box.half_widths
    displacements[:, 1] = 0.0  # the turn to the right: all of it is tried
    down = min(TURN_DOWN_RAD, box.rotation_rad)
    contrasts, turns = coarse.best_turned(box.poses(displacements), (box.rotation_rad, down))
    turned = _turn(displacements, turns)
    return list(turned[np.argsort(PENALTY * box.excess(turned) - contrasts)])


def _turn(displacements: Array, turns: Array) -> Array:
    """Displacements (n, 6) after the view has moved by (n, 2) angles to the right and down."""
    extra = Rotation.from_euler("xy", np.column_stack([-turns[:, 1], turns[:, 0]]))
    rotation = extra * Rotation.from_rotvec(displacements[:, :3])
    return np.column_stack([rotation.as_rotvec(), extra.apply(displacements[:, 3:])])


def _apart(displacements: Sequence[Array], most: int) -> list[Array]:
    """The first of them that are not near to one before."""
    kept: list[Array] = []
    for displacement in displacements:
        if all((np.abs(displacement - other) > APART).any() for other in kept):
            kept.append(displacement)
        if len(kept) == most:
            break
    return kept


def _climbed(
    responses: Responses,
    box: Box,
    starts: Sequence[Array],
    spread: Array,
    rng: np.random.Generator,
) -> list[Array]:
    """Where the contrast is best near each start; best first."""

    def penalised(displacements: Array) -> Array:
        contrasts = responses.contrasts(box.poses(displacements))
        return contrasts - PENALTY * box.excess(displacements)

    found = [
        maximize(
            penalised,
            start=start,
            spread=spread,
            limit=REACH * spread,
            samples=CLIMB_SAMPLES,
            steps=CLIMB_STEPS,
            rng=rng,
        )
        for start in starts
    ]
    found.sort(key=lambda pair: -pair[1])
    return [displacement for displacement, _ in found]
