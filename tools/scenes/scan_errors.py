"""The errors of real scans: wrong beam angles, wide beams, motion, bias."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.simulation.world import Hits, World, cast

_PARTS = 7  # rays of a wide beam: its middle, and a ring at 0.7 of its radius
_RING = 0.7
_ONE_SURFACE_M = 0.5  # between parts of a beam that return as one
_BLACK = 0.1  # brightness by which the bias of the range falls to 1/e


@dataclass(frozen=True, kw_only=True)
class ScanErrors:
    """Errors of a spinning LiDAR, constant over a recording.

    Attributes:
        elevations_deg: true minus reported elevation of each beam; empty for none.
        beam_mrad: full width of a beam; what lies foremost in it returns, if two parts in seven
            meet it.
        motion_m: drive ahead during a turn, for which the points are not corrected.
        dark_m: range bias of black surfaces.
    """

    elevations_deg: tuple[float, ...] = ()
    beam_mrad: float = 0.0
    motion_m: float = 0.0
    dark_m: float = 0.0

    def cast(
        self, world: World, T_world_lidar: Array, shots: Array
    ) -> tuple[NDArray[np.float32], Hits]:
        """Cast beams of some width from a sensor that moves.

        Args:
            world: surfaces.
            T_world_lidar: (4, 4) when the sensor looks ahead.
            shots: (n, 3) unit vectors in the LiDAR's frame, with the errors of the elevations.

        Returns:
            (n, 3) directions in the world, and what they meet; of a wide beam the mean distance of
            the surface that returns, and a place on it.
        """
        R = T_world_lidar[:3, :3]
        origins = T_world_lidar[:3, 3]
        if self.motion_m:
            share_of_turn = np.arctan2(shots[:, 1], shots[:, 0]) / (2 * np.pi)
            origins = origins + self.motion_m * share_of_turn[:, None] * R[:, 0]
        middle = (shots @ R.T).astype(np.float32)
        if not self.beam_mrad:
            return middle, cast(world, origins, middle)
        parts = [(shots + offset) @ R.T for offset in _parts_of_beam(shots, self.beam_mrad)]
        hits = [cast(world, origins, part.astype(np.float32)) for part in parts]
        return middle, foremost(hits)

    def bias_m(self, brightness: Array) -> Array:
        """(n,) bias of the ranges; brightness as in ``return_chance``."""
        return np.asarray(self.dark_m * np.exp(-brightness / _BLACK))


def draw_scan_errors(beams: int, size: float, rng: np.random.Generator) -> ScanErrors:
    """Errors of one sensor.

    At size 1: elevations wrong by 0.05 deg all alike, by 0.05 deg at the outermost beams and
    linearly between, and by 0.04 deg each (standard deviations); beams 1 to 3.5 mrad wide; 0.1 m of
    motion left per turn (standard deviation); up to 3 cm of bias on black.
    """
    tilt = np.linspace(-1.0, 1.0, beams)
    alike, along = rng.normal(0.0, 0.05, 2)
    elevations = size * (alike + along * tilt + rng.normal(0.0, 0.04, beams))
    return ScanErrors(
        elevations_deg=tuple(elevations.tolist()),
        beam_mrad=size * rng.uniform(1.0, 3.5),
        motion_m=size * rng.normal(0.0, 0.1),
        dark_m=size * rng.uniform(0.0, 0.03),
    )


def _parts_of_beam(shots: Array, beam_mrad: float) -> list[Array]:
    """Offsets (n, 3) of the rays of a beam from its middle."""
    left = np.column_stack([-shots[:, 1], shots[:, 0], np.zeros(len(shots))])
    left /= np.linalg.norm(left, axis=1)[:, None]
    up = np.cross(shots, left)
    radius = _RING * beam_mrad / 2000.0
    turns = 2 * np.pi * np.arange(_PARTS - 1) / (_PARTS - 1)
    ring = [radius * (np.cos(turn) * left + np.sin(turn) * up) for turn in turns]
    return [np.zeros_like(shots), *ring]


def foremost(hits: list[Hits]) -> Hits:
    """The returned range: the foremost surface that at least two parts of the beam meet."""
    distances = np.stack([part.distance_m for part in hits])
    order = np.argsort(distances, axis=0)
    ranked = np.take_along_axis(distances, order, axis=0)
    with np.errstate(invalid="ignore"):  # infinite ones, of parts that meet nothing
        gaps = np.diff(ranked, axis=0) > _ONE_SURFACE_M
    ends = gaps[1:]
    last = 1 + np.where(ends.any(axis=0), ends.argmax(axis=0), len(hits) - 2)
    first = gaps[0].astype(np.int64)
    rank = np.arange(len(hits))[:, None]
    inside = (rank >= first) & (rank <= last)
    mean = np.where(inside & np.isfinite(ranked), ranked, 0.0).sum(axis=0) / inside.sum(axis=0)
    one = order[1], np.arange(distances.shape[1])
    return Hits(
        distance_m=np.where(np.isfinite(ranked[1]), mean, np.inf).astype(np.float32),
        triangle=np.stack([part.triangle for part in hits])[one],
        within=np.stack([part.within for part in hits])[one],
    )
