"""Parameters of a lens and a clock that were estimated together with the extrinsics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

_PRIOR_SHARE = 0.9  # of the prior's standard deviation: above, the data have said nothing
_TIED, _TIED_SHARE = 0.999, 0.5
"""From this correlation with the pose on, half the prior: the prior of the pose narrows it, too."""

_NONE = 0.005  # correlations that are shown as 0.00
_LEFT_SIGMAS = 2.0  # from the prior: beyond, they have


@dataclass(frozen=True)
class LensEstimate:
    """One parameter of a camera's lens or clock.

    Attributes:
        name: ``focal`` (the root of fx fy), ``aspect`` (fx / fy), ``centre_x``, ``centre_y``, a
            distortion coefficient, or ``offset`` and ``readout`` of the clock.
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

    @property
    def trade_off(self) -> str:
        """Which change of the pose may be a change of it, in words; empty if none."""
        if self.correlation <= _NONE:
            return ""
        pair = f"{self.name} with {self.direction} {self.correlation:.2f}"
        return f"part of it may be the other, by their correlation: {pair}"

    def describe(self) -> str:
        """Whether the data determine it, and what it cannot be told from."""
        pair = f"with {self.direction} {self.correlation:.2f}" if self.correlation > _NONE else ""
        if self.is_determined:
            return pair
        needed = "; record turns and changes of speed" if self.name in ("offset", "readout") else ""
        return "; ".join(filter(None, (f"not determined by these data{needed}", pair)))


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
