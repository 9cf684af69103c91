"""Parameters of a lens and a clock that were estimated together with the extrinsics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibgraph.model.rig import Camera, IntrinsicsSigma, Rig

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
"""Of a distortion coefficient: below."""
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
        decimals = max(0, 1 - math.floor(math.log10(scale * self.sigma)))
        value, sigma, prior, prior_sigma = (
            f"{scale * number:.{decimals}f}"
            for number in (self.value, self.sigma, self.prior, self.prior_sigma)
        )
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
        undetermined = f"not determined by these data; record {self.needed}"
        return "; ".join(filter(None, (undetermined, pair)))

    @property
    def needed(self) -> str:
        """What to record, so that the data determine it."""
        return _NEEDED.get(self.name, "matches near the corners of the image")


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
