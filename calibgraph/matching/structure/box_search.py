"""Box search: the poses within a range of a guess at which a body's correlation maps agree best.

Samples of the box are shifted to where the view agrees best, and refined on blurred maps, then on
sharper ones. Each stage keeps the best, without near duplicates.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.matching.structure.consensus import maximize
from calibgraph.matching.structure.correlation_maps import CorrelationMaps
from calibgraph.model.geometry import invert, relative_transform

COARSE_BLUR_CELLS, COARSE_EVERY, FINE_BLUR_CELLS = 2.0, 2, 1.0
SAMPLES = 1024  # of the box
SHIFT_DOWN_RAD = np.radians(6.0)  # a smaller rotation down is nearly a shift of the maps
COARSE_STARTS, FINE_STARTS, CANDIDATES = 24, 12, 8  # how many go on from each stage
DUPLICATE = np.repeat([np.radians(3.0), 0.6], 3)  # nearer poses are duplicates
COARSE_SIGMAS = np.repeat([np.radians(1.5), 0.3], 3)
FINE_SIGMAS = np.repeat([np.radians(0.8), 0.15], 3)
REACH_SIGMAS = 2.5
REFINE_SAMPLES, REFINE_STEPS = 60, 6
PENALTY = 10.0  # of the z-score, per half-width outside of the box


@dataclass(frozen=True, eq=False)
class Box:
    """The extrinsics T_delta guess, with T_delta within a range per axis.

    Attributes:
        guess_T_camera_lidar: (4, 4).
        rotation_rad, translation_m: half-widths, per axis of the camera.
    """

    guess_T_camera_lidar: Array
    rotation_rad: float
    translation_m: float

    @property
    def half_widths(self) -> Array:
        """(6,)."""
        return np.repeat([self.rotation_rad, self.translation_m], 3)

    def transforms(self, displacements: Array) -> Array:
        """(n, 4, 4) T_camera_lidar of displacements (n, 6): rotation vector [rad], shift [m]."""
        T = np.zeros((len(displacements), 4, 4))
        T[:, 3, 3] = 1.0
        T[:, :3, :3] = Rotation.from_rotvec(displacements[:, :3]).as_matrix()
        T[:, :3, 3] = displacements[:, 3:]
        return np.asarray(T @ self.guess_T_camera_lidar)

    def displacements(self, T_camera_lidar: Array) -> Array:
        """(n, 6) the displacements of extrinsics (n, 4, 4) from the guess."""
        T = relative_transform(T_camera_lidar, self.guess_T_camera_lidar)
        rotations = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
        return np.column_stack([rotations, T[:, :3, 3]])

    def excess(self, displacements: Array) -> Array:
        """(n,) distance outside of the box in half-widths, summed over the axes."""
        return np.asarray(np.maximum(np.abs(displacements) / self.half_widths - 1, 0).sum(axis=1))


@dataclass(frozen=True, eq=False)
class BodyMaps:
    """The correlation maps of the cameras of a body, the lead's first.

    Attributes:
        maps: one per camera.
        T_camera_lead: (4, 4) of each.
    """

    maps: Sequence[CorrelationMaps]
    T_camera_lead: Sequence[Array]

    def blur(self, sigma_cells: float, every: int = 1) -> BodyMaps:
        """The body with its maps blurred and subsampled."""
        return replace(self, maps=[maps.blur(sigma_cells, every) for maps in self.maps])

    def z_scores(self, T_lead_lidar: Array) -> Array:
        """(n,) of all cameras together (Stouffer's), at (n, 4, 4) transforms."""
        each = zip(self.maps, self.T_camera_lead, strict=True)
        total = sum(maps.z_scores(T_camera_lead @ T_lead_lidar) for maps, T_camera_lead in each)
        return np.asarray(total / np.sqrt(len(self.maps)))


def search_box(
    maps: BodyMaps, box: Box, cores: Executor, *, effort: int = 1, seed: int
) -> list[Array]:
    """Find the best extrinsics in a box.

    Returns:
        T_lead_lidar (4, 4), best first, without near duplicates.
    """
    rng = np.random.default_rng(seed)
    coarse = maps.blur(COARSE_BLUR_CELLS, COARSE_EVERY)
    starts = _suppress_duplicates(_sample(coarse, box, rng), effort * COARSE_STARTS)
    rough = _refine(coarse, box, starts, COARSE_SIGMAS, rng=rng, cores=cores)[
        : effort * FINE_STARTS
    ]
    fine = maps.blur(FINE_BLUR_CELLS)
    refined = _refine(fine, box, [start for start, _ in rough], FINE_SIGMAS, rng=rng, cores=cores)
    best_first = [displacement for displacement, _ in refined]
    return list(box.transforms(np.array(_suppress_duplicates(best_first, effort * CANDIDATES))))


def _sample(maps: BodyMaps, box: Box, rng: np.random.Generator) -> list[Array]:
    """Samples of the box at which the views of one of the cameras agree best; best first."""
    samples = [
        _sample_camera(of_camera, T_camera_lead, box, rng)
        for of_camera, T_camera_lead in zip(maps.maps, maps.T_camera_lead, strict=True)
    ]
    displacements, values = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    return list(displacements[np.argsort(-values)])


def _sample_camera(
    coarse: CorrelationMaps, T_camera_lead: Array, box: Box, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(n, 6) displacements of the lead and (n,) values of samples of a camera's box.

    Each is shifted to the right and down to its best z-score.
    """
    from scipy.stats import qmc  # takes half a second, which solve() does not need

    own = replace(box, guess_T_camera_lidar=T_camera_lead @ box.guess_T_camera_lidar)
    unit = qmc.Sobol(6, seed=rng).random(SAMPLES)
    displacements = (2 * unit - 1) * box.half_widths
    displacements[:, 1] = 0.0  # all rotations to the right are tried by the shift
    down = min(SHIFT_DOWN_RAD, box.rotation_rad)
    transforms = own.transforms(displacements)
    z_scores, shifts = coarse.find_best_shifts(transforms, (box.rotation_rad, down))
    shifted = own.transforms(_shift_view(displacements, shifts))
    of_lead = box.displacements(invert(T_camera_lead) @ shifted)
    return of_lead, z_scores - PENALTY * box.excess(of_lead)


def _shift_view(displacements: Array, shifts: Array) -> Array:
    """Displacements (n, 6) after the view has shifted by (n, 2) angles to the right and down."""
    extra = Rotation.from_euler("xy", np.column_stack([-shifts[:, 1], shifts[:, 0]]))
    rotation = extra * Rotation.from_rotvec(displacements[:, :3])
    return np.column_stack([rotation.as_rotvec(), extra.apply(displacements[:, 3:])])


def _suppress_duplicates(displacements: Sequence[Array], most: int) -> list[Array]:
    """The first of them, without those that are near an earlier one."""
    kept: list[Array] = []
    for displacement in displacements:
        if all((np.abs(displacement - other) > DUPLICATE).any() for other in kept):
            kept.append(displacement)
        if len(kept) == most:
            break
    return kept


def _refine(
    maps: BodyMaps,
    box: Box,
    starts: Sequence[Array],
    sigmas: Array,
    *,
    rng: np.random.Generator,
    cores: Executor,
) -> list[tuple[Array, float]]:
    """The displacement of the best z-score near each start, and that; best first."""

    def penalised(displacements: Array) -> Array:
        z_scores = maps.z_scores(box.transforms(displacements))
        return z_scores - PENALTY * box.excess(displacements)

    def maximize_from(start: Array, own_rng: np.random.Generator) -> tuple[Array, float]:
        return maximize(
            penalised,
            start=start,
            sigmas=sigmas,
            half_widths=REACH_SIGMAS * sigmas,
            samples=REFINE_SAMPLES,
            steps=REFINE_STEPS,
            rng=own_rng,
        )

    maxima = cores.map(maximize_from, starts, rng.spawn(len(starts)))
    return sorted(maxima, key=lambda pair: -pair[1])
