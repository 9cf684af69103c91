"""Lenses and clocks: what was estimated with the extrinsics, what is known, how two differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera, IntrinsicsSigma, Rig
from factors import unproject

_PRIOR_SHARE = 0.9  # of the prior's standard deviation: above, the data have said nothing
_TIED, _TIED_SHARE = 0.999, 0.5
"""From this correlation with the pose on, half the prior: the prior of the pose narrows it, too."""

_NONE = 0.005  # correlations that are shown as 0.00
_NEEDED = {
    "focal": "several distances, towards the corners, too",
    "centre_x": "near and far things over the whole image",
    "centre_y": "near and far things over the whole image",
    "offset": "turns and changes of speed",
    "readout": "turns and changes of speed",
}
_LEAST_S = 1e-6  # that a rig may state
_LEFT_SIGMAS = 2.0  # from the prior: beyond, they have


@dataclass(frozen=True)
class LensEstimate:
    """One parameter of a camera's lens or clock.

    Attributes:
        name: ``focal`` (the root of fx fy), ``centre_x``, ``centre_y``, a distortion
            coefficient, or ``offset`` and ``readout`` of the clock.
        unit: ``px``, ``s`` or empty.
        value: the estimate.
        sigma: its standard deviation: the marginal of the graph.
        prior: what the rig states.
        prior_sigma: its standard deviation.
        direction: of the camera's pose that has the largest correlation with it.
        correlation: its size, 0 to 1.
    """

    name: str
    unit: str
    value: float
    sigma: float
    prior: float
    prior_sigma: float
    direction: str
    correlation: float

    @property
    def is_determined(self) -> bool:
        """Whether the data have narrowed or left the prior."""
        left = abs(self.value - self.prior) > _LEFT_SIGMAS * self.sigma
        share = _PRIOR_SHARE if self.correlation < _TIED else _TIED_SHARE
        return left or self.sigma < share * self.prior_sigma

    @property
    def prior_sigmas(self) -> float:
        """How many standard deviations of the prior the estimate lies from what the rig states."""
        return abs(self.value - self.prior) / self.prior_sigma

    @property
    def printed(self) -> tuple[str, str, str, str]:
        """Value, sigma, prior and its sigma in ``printed_unit``, to two digits of the sigma."""
        scale = 1e3 if self.unit == "s" else 1.0
        places = max(0, 1 - math.floor(math.log10(scale * self.sigma)))
        numbers = np.multiply(scale, (self.value, self.sigma, self.prior, self.prior_sigma))
        value, sigma, prior, prior_sigma = (f"{number:.{places}f}" for number in numbers)
        return value, sigma, prior, prior_sigma

    @property
    def printed_unit(self) -> str:
        """``px``, ``ms`` or empty."""
        return "ms" if self.unit == "s" else self.unit

    @property
    def change(self) -> str:
        """The estimate, its standard deviation and the value that the rig states, in words."""
        new, sigma, old, _ = self.printed
        unit = f" {self.printed_unit}" if self.unit else ""
        return f"{self.name} {new} +- {sigma}{unit}, before {old}{unit}"

    def describe(self) -> str:
        """Whether the data determine it, and what it cannot be told from."""
        pair = f"with {self.direction} {self.correlation:.2f}" if self.correlation > _NONE else ""
        if self.is_determined:
            return pair
        needed = _NEEDED.get(self.name, "matches near the corners of the image")
        return "; ".join(filter(None, (f"not determined by these data; record {needed}", pair)))


POSE_PARAMETERS = tuple(
    f"{kind}_{axis}_{unit}" for kind, unit in (("rotation", "rad"), ("translation", "m"))
    for axis in "xyz"
)  # fmt: skip
"""Of xi in T_camera_lidar = exp(xi) estimate."""


def joint_parameters(lens: Sequence[LensEstimate]) -> list[str]:
    """Names, with units, of the rows of the joint covariance of a pose and its lens."""
    return [*POSE_PARAMETERS, *("_".join(filter(None, (one.name, one.unit))) for one in lens)]


def with_sigmas(rig: Rig, lens: Mapping[str, tuple[LensEstimate, ...]]) -> Rig:
    """A rig with estimated lenses and clocks that states their standard deviations.

    Of both coordinates of the centre, and of all radial coefficients, the larger.
    """
    if not lens:
        return rig
    stated = {name: _sigmas_of(rig.cameras[name], estimates) for name, estimates in lens.items()}
    cameras = {n: c.model_copy(update=stated.get(n, {})) for n, c in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def _sigmas_of(camera: Camera, estimates: Sequence[LensEstimate]) -> dict[str, Any]:
    """The fields of a camera in a rig."""
    sigmas = {one.name: one.sigma for one in estimates}
    found: dict[str, Any] = {
        f"{field}_sigma_s": max(sigmas[name], _LEAST_S)
        for name, field in (("offset", "time_offset"), ("readout", "readout"))
        if name in sigmas
    }
    if radial := [sigma for name, sigma in sigmas.items() if name.startswith("k")]:
        found["distortion_sigma"] = max(radial)
    pixels = {}
    if "focal" in sigmas:
        (focal,) = (one for one in estimates if one.name == "focal")
        pixels["focal"] = focal.sigma / focal.value * camera.intrinsics_px.fx
    if "centre_x" in sigmas:
        pixels["centre"] = max(sigmas["centre_x"], sigmas["centre_y"])
    if pixels:
        known = camera.intrinsics_sigma_px or IntrinsicsSigma()
        found["intrinsics_sigma_px"] = known.model_copy(update=pixels)
    return found


def unsettled(parts: Sequence[str], change: float, repeats: int) -> str:
    """A warning that what is estimated still changes by some sigmas when it is matched again."""
    return (
        f"{', '.join(parts)}: after {repeats} repeats of the matching still changes by "
        f"{change:.1f} sigma; estimate fewer parts, or give more frames"
    )


def change_of_lens(
    before: Mapping[str, tuple[LensEstimate, ...]], after: Mapping[str, tuple[LensEstimate, ...]]
) -> float:
    """Largest change of a parameter in its standard deviations; infinite where none was known."""
    changes = [
        abs(new.value - old.value) / new.sigma if name in before else math.inf
        for name, parameters in after.items()
        for new, old in zip(parameters, before.get(name, parameters), strict=True)
    ]
    return max(changes, default=0.0)


class LensSigmas(NamedTuple):
    """Standard deviations of a lens and a clock where the rig states none.

    Of the logarithm of both focal lengths, of each coordinate of the centre [px],
    of radial coefficients (tangential ones have ``TANGENTIAL_SHARE`` of these), of offset and
    read-out.
    """

    focal: float
    centre_px: float
    radial: float
    offset_s: float
    readout_s: float

    @staticmethod
    def calibrated(camera: Camera) -> LensSigmas:
        """Of a lens calibrated with a target, and of triggered images: 0.2 %, 2 of 1000 px, 5 ms.

        A read-out that the rig does not state is taken for none.
        """
        share = _CALIBRATED
        return LensSigmas(share, share * camera.intrinsics_px.fx, share, 0.005, 0.0)

    def state_in(self, camera: Camera) -> Camera:
        """A camera with these sigmas, unless it states its own."""
        if camera.intrinsics_sigma_px is not None:
            return camera
        focal_px = round(self.focal * camera.intrinsics_px.fx, 2)
        sigma = IntrinsicsSigma(focal=focal_px, centre=round(self.centre_px, 2))
        radial = camera.distortion_sigma or self.radial
        return camera.model_copy(update={"intrinsics_sigma_px": sigma, "distortion_sigma": radial})


IN_DOUBT = LensSigmas(0.02, 5.0, 0.05, 0.05, 0.03)
"""Of a lens that is estimated, or known from words, a spec sheet or a field of view; of a clock
that is estimated: half a turn of a LiDAR, and a usual read-out."""
_CALIBRATED = 0.002


def state_calibrated(rig: Rig) -> Rig:
    """A rig whose lenses are from a calibration, with the sigmas of one where it states none."""
    cameras = {n: LensSigmas.calibrated(c).state_in(c) for n, c in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def has_other_lens(camera: Camera, other: Camera) -> bool:
    """Whether two lenses differ, or the sizes of their images."""
    one, two = (
        (each.width_px, each.height_px, each.model, each.lens.packed.tolist())
        for each in (camera, other)
    )
    return one != two


def corner_distance_px(camera: Camera, other: Camera) -> float:
    """How far at most two lenses see the ray of a corner of the image apart.

    Infinite where one of them has no such ray, NaN where the images differ in size.
    """
    if (camera.width_px, camera.height_px) != (other.width_px, other.height_px):
        return float("nan")
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    apart = lens_difference(camera, other, corners)
    return float(np.nan_to_num(np.hypot(*apart.T), nan=np.inf).max())


def lens_difference(camera: Camera, other: Camera, pixels_px: Array) -> Array:
    """How far another lens, of as large an image, sees the rays of (n, 2) pixels from them.

    Returns:
        (n, 2) pixels of the other lens less these; NaN where a lens has no such ray.
    """
    rays, known = unproject(camera.lens, pixels_px)
    seen, valid = other.lens.project(rays)
    known &= valid
    return np.asarray(np.where(known[:, None], seen - pixels_px, np.nan))
