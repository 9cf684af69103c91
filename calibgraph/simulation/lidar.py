"""A spinning LiDAR in a simulated world."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.simulation.world import Hits, World, cast, find_albedos

Points = NDArray[np.float32]

_REFERENCE_M = 100.0


class SensorErrors(Protocol):
    """Errors of a LiDAR; experiments draw them (``tools.scenes.scan_errors``)."""

    @property
    def elevations_deg(self) -> tuple[float, ...]:
        """True minus reported elevation of each beam; empty for none."""

    def cast(self, world: World, T_world_lidar: Array, shots: Array) -> tuple[Points, Hits]:
        """(n, 3) directions of shots in the world, and what they meet."""

    def bias_m(self, brightness: Array) -> Array:
        """(n,) bias of the ranges, by brightness as in :func:`return_chance`."""


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """A spinning LiDAR.

    Attributes:
        elevations_deg: of the beams, evenly spaced.
        azimuth_step_deg: between two shots of a beam.
        azimuths_deg: first and last azimuth of the shots, from the x axis to the left.
        min_range_m: nearer returns are dropped.
        max_range_m: farther returns are dropped.
        range_noise_m: standard deviation.
        intensity_noise: standard deviation.
        ring_spread: standard deviation of the beams' gains, about 1.
        dropout: share of shots that are lost at random.
        weakest: albedo at which 1 - 1/e of the shots return from 100 m at normal incidence.
        errors: of the sensor; None for an ideal one.
    """

    elevations_deg: tuple[float, ...]
    azimuth_step_deg: float = 0.2
    azimuths_deg: tuple[float, float] = (-180.0, 180.0)
    min_range_m: float = 1.0
    max_range_m: float = 100.0
    range_noise_m: float = 0.02
    intensity_noise: float = 0.015
    ring_spread: float = 0.05
    dropout: float = 0.01
    weakest: float = 0.06
    errors: SensorErrors | None = None

    def __post_init__(self) -> None:
        beams = len(self.elevations_deg)
        found = 0 if self.errors is None else len(self.errors.elevations_deg)
        if found not in (0, beams):
            raise ValueError(f"errors of {found} elevations for {beams} beams: one per beam, or ()")


_ELEVATIONS_DEG = {16: (15.0, -15.0), 32: (10.0, -25.0), 64: (2.0, -24.8), 128: (15.0, -25.0)}
_SECTOR_BEAMS = 32
_SECTOR = {"azimuths_deg": (-46.0, 114.0), "azimuth_step_deg": 0.4}  # small clouds: data/sample


def lidar_of(beams: int) -> Lidar:
    """A LiDAR by its number of beams.

    Args:
        beams: 16 (15 to -15 deg), 64 (2 to -24.8) or 128 (15 to -25), every 0.2 deg all round; or
            32 (10 to -25), every 0.4 deg from 46 deg to the right to 114 deg to the left.

    Raises:
        ValueError: for another number of beams.
    """
    if beams not in _ELEVATIONS_DEG:
        known = ", ".join(map(str, _ELEVATIONS_DEG))
        raise ValueError(f"{beams} beams: a LiDAR has one of {known}")
    elevations_deg = tuple(np.linspace(*_ELEVATIONS_DEG[beams], beams).tolist())
    sector: dict[str, Any] = _SECTOR if beams == _SECTOR_BEAMS else {}
    return Lidar(elevations_deg=elevations_deg, **sector)


def ring_gains(lidar: Lidar, rng: np.random.Generator) -> Array:
    """(beams,) intensity gains, constant over a recording."""
    return 1 + lidar.ring_spread * rng.standard_normal(len(lidar.elevations_deg))


def scan(
    world: World, lidar: Lidar, gains: Array, T_world_lidar: Array, *, rng: np.random.Generator
) -> Points:
    """Scan the world in one instant, as a moving sensor after motion compensation.

    Without ``errors`` a shot has no width, and every point lies on a surface.

    Args:
        world: surfaces.
        lidar: the sensor.
        gains: (beams,) of the intensities.
        T_world_lidar: (4, 4); LiDAR x is forward, y left, z up.
        rng: draws noise, dropouts and the order.

    Returns:
        (n, 4) x y z [m] in the LiDAR's frame and intensity in 0 to 1, in random order.
    """
    shots = shot_directions(lidar)
    if (errors := lidar.errors) is None:
        directions = (shots @ T_world_lidar[:3, :3].T).astype(np.float32)
        hits = cast(world, T_world_lidar[:3, 3], directions)
    else:
        fired = shot_directions(lidar, errors.elevations_deg)
        directions, hits = errors.cast(world, T_world_lidar, fired)
    albedo, incidence = find_albedos(world, directions, hits)
    gain = np.repeat(gains, len(shots) // len(gains))
    intensity = albedo[:, 3] * (0.55 + 0.45 * incidence) * gain
    intensity += rng.normal(0, lidar.intensity_noise, len(shots))
    distance = hits.distance_m + rng.normal(0, lidar.range_noise_m, len(shots))
    distance += 0.0 if errors is None else errors.bias_m(albedo[:, 3] * incidence)
    kept = (distance > lidar.min_range_m) & (distance < lidar.max_range_m)
    kept &= rng.random(len(shots)) < return_chance(lidar, albedo[:, 3] * incidence, distance)
    order = rng.permutation(np.flatnonzero(kept))
    xyz = shots[order] * distance[order, None]
    return np.column_stack([xyz, intensity[order].clip(0, 1)]).astype(np.float32)


def shot_directions(lidar: Lidar, errors_deg: tuple[float, ...] = ()) -> Array:
    """(beams * steps, 3) unit vectors in the LiDAR's frame, beam by beam.

    Args:
        lidar: the sensor.
        errors_deg: added to the elevations that it reports, per beam.
    """
    azimuth_deg = np.arange(*lidar.azimuths_deg, lidar.azimuth_step_deg)
    elevations_deg = np.add(lidar.elevations_deg, errors_deg or 0.0)
    azimuth, elevation = np.meshgrid(np.radians(azimuth_deg), np.radians(elevations_deg))
    flat = np.cos(elevation)
    shots = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
    return np.stack(shots, axis=-1).reshape(-1, 3)


def return_chance(lidar: Lidar, brightness: Array, distance_m: Array) -> Array:
    """(n,) probability that a shot returns: lower from dark, far and slanted surfaces.

    Args:
        lidar: the sensor.
        brightness: (n,) albedo times the cosine of the angle of incidence.
        distance_m: (n,) may be infinite.
    """
    light = brightness * (_REFERENCE_M / np.maximum(distance_m, lidar.min_range_m)) ** 2
    return np.asarray((1 - lidar.dropout) * -np.expm1(-light / lidar.weakest))
