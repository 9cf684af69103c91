"""The posterior of a camera's lens and clock by its matches, all parameters and the pose at once.

Each parameter is usual or, rarely, wrong, and its error then normal with another spread. The
posterior is the mixture over which are wrong: it tells which of several are to blame, and the pose
that goes with them. Parameters are in standard deviations of a lens that was calibrated with a
target, or of those that the rig states. Half of a skew, which no lens of a rig has, is a rotation
about the axis; the other half is a field of displacements of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit, softmax

from calibgraph.arrays import Array
from calibgraph.graph.lens import LensSigmas, LensVariable
from calibgraph.model.clock import clock_of
from calibgraph.model.config import LensPart
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import free_fields_px
from calibgraph.solver.linear_fit import LinearFit
from calibgraph.trust.thresholds import limit
from factors import FreeLens
from factors.free_lens import ASPECT, CENTRE_X, CENTRE_Y, FOCAL, OFFSET


class Free(IntEnum):
    """What is free, by number: parameters of a lens, the skew, and the clock if it shows."""

    FOCAL, RADIAL, CENTRE_X, CENTRE_Y, ASPECT, SKEW, OFFSET = range(7)


TIME = "time offset"
NAMES = (
    "focal length", "distortion", "principal point", "principal point", "aspect ratio", "skew", TIME
)  # fmt: skip
"""What reports call them; both coordinates of a principal point are wrong together."""

SHAPES = Free.ASPECT, Free.SKEW
"""Those that no lens has wrong by much.

Matches from rounds follow them, so that they count if the camera hardly moves, and beside other
parameters that are free: beside usual ones, KITTI 00 and a street with an fy 5 % off would PASS.
"""

_FREE = FOCAL, "k1", CENTRE_X, CENTRE_Y, ASPECT
_PARTS: tuple[LensPart, ...] = "focal", "aspect", "centre", "distortion"
_SKEW_SIGMA = 0.002  # in parts of fx
_USUAL_SIGMA_S = 0.002  # of an offset, where the rig states none: of sensors that are synchronised
_SAMPLES = 1000  # of the lens where some parameters are wrong
_RARE = 5e-4  # sets of wrong parameters: much less than what decides


def lens_variable(camera: Camera) -> LensVariable:
    """The lens of a camera with the parameters that are checked, at its calibration."""
    all_of = LensVariable.of(camera, _PARTS, LensSigmas.calibrated(camera)).free
    sigmas = dict(zip(all_of.parameters, all_of.sigmas, strict=True))
    free = FreeLens(camera.lens, _FREE, tuple(sigmas[name] for name in _FREE))
    return LensVariable(camera, free, np.zeros(len(free)))


def free_of(camera: Camera, *, is_timed: bool) -> tuple[Free, ...]:
    """What is free of a camera: of a panorama the format determines the lens."""
    lens = () if camera.model == "equirectangular" else tuple(Free)[: Free.OFFSET]
    return (*lens, Free.OFFSET) if is_timed else lens


def units_of(camera: Camera, free: Sequence[Free]) -> Array:
    """(k,) standard deviations of a calibrated lens: relative, pixels, of k1; or seconds."""
    lens = lens_variable(camera).free.sigmas if Free.FOCAL in free else [math.nan] * len(_FREE)
    offset_s = camera.time_offset_sigma_s or _USUAL_SIGMA_S
    return np.array([*lens, _SKEW_SIGMA, offset_s])[[*free]]


def fields_px(
    camera: Camera, free: Sequence[Free], points_lidar_m: Array, twist_per_s: Array | None = None
) -> Array:
    """(k, 2, n) derivatives of the pixels by what is free.

    Args:
        camera: lens, clock and extrinsic.
        free: what, by :func:`free_of`.
        points_lidar_m: (n, 3) where they are when their pixels are taken.
        twist_per_s: (n, 6) of the LiDAR, for an offset.
    """
    fields = [] if Free.FOCAL not in free else [_lens_fields_px(camera, points_lidar_m)]
    if Free.OFFSET in free:
        clock = FreeLens(
            camera.lens, (OFFSET,), tuple(units_of(camera, [Free.OFFSET])), clock_of(camera)
        )
        fields.append(free_fields_px(camera, clock, points_lidar_m, twist_per_s))
    return np.concatenate(fields)


def _lens_fields_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(6, 2, n) by the lens and the skew."""
    free, k = lens_variable(camera).free, camera.intrinsics_px
    fields = free_fields_px(camera, free, points_lidar_m)
    off_centre = fields[Free.FOCAL] / free.sigmas[Free.FOCAL]
    skew = 0.5 * _SKEW_SIGMA * off_centre[::-1] * [[k.fx / k.fy], [k.fy / k.fx]]
    return np.concatenate([fields, skew[None]])


@dataclass(frozen=True, eq=False)
class LensParameter:
    """One parameter of a lens by its posterior.

    Attributes:
        name: one of ``NAMES``.
        values: (m,) mean of the change, in standard deviations of a calibrated lens.
        sigmas: (m,) their standard deviations.
        units: (m,) of the values: relative, pixels, of k1, or seconds.
        by_unit: (6, m) rotation [rad] and translation [m] by which the camera follows each.
        probability: that it is wrong, and the camera off by more than the tolerance: what the data
            add to it.
        is_determined: whether the data would show a wrong one.
    """

    name: str
    values: Array
    sigmas: Array
    units: Array
    by_unit: Array
    probability: float
    is_determined: bool

    @property
    def moved(self) -> tuple[float, float]:
        """How far the camera would turn [deg] and its centre move [cm]."""
        turned, shifted = np.linalg.norm((self.by_unit @ self.values).reshape(2, 3), axis=1)
        return float(np.degrees(turned)), 100 * float(shifted)


class _Mixture(NamedTuple):
    """The lens by which of d sets of g names are wrong: probabilities and moments of each set."""

    wrong: Array  # (d, g)
    before: Array  # (d,)
    after: Array  # (d,) by the data
    spreads: Array  # (d, k) before
    means: Array  # (d, k) after
    covariances: Array  # (d, k, k) after


@dataclass(frozen=True, eq=False)
class LensPosterior:
    """Of a fit with all parameters free.

    Attributes:
        free: (k,) parameters.
        units: (k,) of these.
        values: (k,) by the fit.
        covariance: (k, k) of these, frames as clusters.
        twist: (6,) of the pose at these values: T_camera_lidar = exp(twist) estimate.
        compensating: (6, k) twists by which the pose makes up for a unit of each.
        shapes: (2,) values, and (2,) variances, of the shapes by the fit in which they are judged.
    """

    free: tuple[Free, ...]
    units: Array
    values: Array
    covariance: Array
    twist: Array
    compensating: Array
    shapes: tuple[Array, Array]

    @staticmethod
    def of(camera: Camera, free: Sequence[Free], fit: LinearFit) -> LensPosterior:
        """Of a fit with these as its first unknowns."""
        freed = fit.free(*range(len(free)))
        moments = freed.values, freed.covariance, freed.twist, freed.compensating
        rows = [row for row, number in enumerate(free) if number in SHAPES]
        shapes = freed.values[rows], np.diag(freed.covariance)[rows]
        return LensPosterior(tuple(free), units_of(camera, free), *moments, shapes)

    @property
    def is_known(self) -> bool:
        """Whether there are the frames to know the covariance by: at least two."""
        return bool(np.isfinite(self.covariance).all())

    @cached_property
    def _mixture(self) -> _Mixture:
        names = self._names
        wrong = np.array([*product((False, True), repeat=len(names))])
        numbers = [names.index(NAMES[number]) for number in self.free]
        odds = logit(limit("lens_wrong_share")) * wrong.sum(axis=1)
        if Free.ASPECT in self.free:  # where fx or fy alone is wrong, so is the focal length
            wrong[:, numbers[Free.FOCAL]] |= wrong[:, numbers[Free.ASPECT]]
        spreads = np.where(wrong[:, numbers], limit("lens_wrong"), limit("lens_usual"))
        variances = spreads[:, :, None] ** 2 * np.eye(len(self.values))
        total = self.covariance + variances
        gain = np.linalg.solve(total, variances).swapaxes(1, 2)
        misfit = np.linalg.solve(total, self.values[:, None])[..., 0]
        fits = misfit @ self.values + np.linalg.slogdet(total).logabsdet
        means, covariances = gain @ self.values, gain @ self.covariance
        return _Mixture(wrong, softmax(odds), softmax(odds - fits / 2), spreads, means, covariances)

    @property
    def _names(self) -> list[str]:
        return [*dict.fromkeys(NAMES[number] for number in self.free)]

    @cached_property
    def mean(self) -> Array:
        """(k,) of the parameters."""
        return np.asarray(self._mixture.after @ self._mixture.means)

    @cached_property
    def sigmas(self) -> Array:
        """(k,) standard deviations of the parameters."""
        of = self._mixture
        within = np.einsum("dkk->dk", of.covariances)
        return np.asarray(np.sqrt(of.after @ (within + (of.means - self.mean) ** 2)))

    def twist_at(self, values: Array) -> Array:
        """(6,) of the pose that fits the matches with (k,) values of the parameters."""
        return np.asarray(self.twist + self.compensating @ (values - self.values))

    def parameters(self, tolerance: tuple[float, float]) -> tuple[LensParameter, ...]:
        """Each of them, for a tolerance [deg, cm]; none of a single frame."""
        if not self.is_known:
            return ()
        values, sigmas = self.mean.copy(), self.sigmas.copy()
        if Free.SKEW in self.free:
            values[[*SHAPES]], sigmas[[*SHAPES]] = self.shapes[0], np.sqrt(self.shapes[1])
        found = []
        for name, probability in zip(self._names, self._probabilities(tolerance), strict=True):
            rows = [row for row, number in enumerate(self.free) if NAMES[number] == name]
            is_open = np.diag(self.covariance)[rows] >= limit("lens_wrong") ** 2
            moments = values[rows], sigmas[rows], self.units[rows], self.compensating[:, rows]
            found.append(LensParameter(name, *moments, float(probability), not is_open.all()))
        return tuple(found)

    def _probabilities(self, tolerance: tuple[float, float]) -> Array:
        """(g,) per name, that it is wrong and the camera beyond the tolerance.

        Of a usual lens, what the data add beyond it counts for all.
        """
        rows = (self._mixture.before > _RARE) | (self._mixture.after > _RARE)
        of = _Mixture(*(each[rows] for each in self._mixture))
        scale = np.repeat([np.radians(tolerance[0]), tolerance[1] / 100], 3)[:, None]
        effect = self.compensating / scale
        sizes, axes = np.linalg.eigh((of.covariances + of.covariances.swapaxes(1, 2)) / 2)
        after = _share_beyond(of.means, axes * np.sqrt(np.maximum(sizes, 0.0))[:, None], effect)
        known = of.spreads[:, :, None] * np.eye(len(self.values))
        before = _share_beyond(np.zeros_like(of.means), known, effect)
        usual = of.after[0] * max(after[0] - before[0], 0.0)
        gained = (of.after * after - of.before * before) @ of.wrong
        if Free.SKEW in self.free:
            gained[[self._names.index(NAMES[shape]) for shape in SHAPES]] = self._gained_alone
        return np.asarray(usual + np.maximum(gained, 0.0))

    @property
    def _gained_alone(self) -> Array:
        """(2,) what the data add to the probability that each shape is wrong."""
        values, variances = self.shapes
        total = variances + np.array([limit("lens_usual"), limit("lens_wrong")])[:, None] ** 2
        evidence = -(values**2 / total + np.log(total)) / 2
        share = limit("lens_wrong_share")
        return np.asarray(expit(logit(share) + evidence[1] - evidence[0]) - share)


def _share_beyond(means: Array, roots: Array, effect: Array) -> Array:
    """(d,) how much of (d, k) means with (d, k, k) roots of covariances moves a camera beyond one.

    Args:
        means: of the parameters.
        roots: of their covariances.
        effect: (6, k) rotation and translation by a unit of each, in tolerances.
    """
    draws = means[:, None] + _standard_normal(means.shape[1]) @ roots.swapaxes(1, 2)
    sizes = np.linalg.norm((draws @ effect.T).reshape(len(means), _SAMPLES, 2, 3), axis=-1)
    return np.asarray((sizes > 1.0).any(axis=-1).mean(axis=-1))


@cache
def _standard_normal(size: int) -> Array:
    """(n, k) numbers, and their opposites."""
    half = np.random.default_rng(0).standard_normal((_SAMPLES // 2, size))
    return np.concatenate([half, -half])
