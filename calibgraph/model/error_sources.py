"""The sources of an error bar: their shares of its variance, and the action that shrinks it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from calibgraph.model.verdict import in_unit

MATCHES = "scatter of the matches"
PLACES = "errors that a place shares"
COMMON = "common error of the matcher"
ELEVATION = "LiDAR's elevation offset"
STRETCH = "LiDAR's elevation scale"
MOTION = "LiDAR's motion during a scan"
PAIRS = "images of camera pairs"
PRIORS = "priors and relative poses"
LENSES = "uncertain lenses and clocks"
ESTIMATED = "estimated lenses and clocks"
OTHER_LIDARS = "poses of other LiDARs"
FLAT = "flat evidence of the images"

NEEDED = 0.3
"""Error bar over tolerance at which 99 % of the errors are within: about what a PASS needs."""

TIMES = (2, 3, 5, 10, 20, 1000)
"""As many frames, at as many times more places: for these the error bar is predicted."""

MOST_TIMES = TIMES[-1]
"""Stands for any number of frames, and is no advice."""

_ADVICE = {
    LENSES: "State how well lenses and clocks are known (intrinsics_sigma_px, distortion_sigma, "
    "time_offset_sigma_s), or calibrate them with a target.",
    MOTION: "Correct the clouds for the motion of the vehicle (--motion for bags, --interval-s for "
    "folders), or record while it stands, two frames or more at each stop. If they are corrected "
    "already, or it stood, state instant_clouds: true in --config.",
    ESTIMATED: "Estimate fewer parts of the lens (--estimate), state how well it is known "
    "(intrinsics_sigma_px, distortion_sigma), or calibrate it with a target.",
}
"""Where most of the error bar is of one of these sources."""

SHRINKS_WITH = {
    MATCHES: "more frames",
    PLACES: "frames at more places",
    COMMON: "measured relative_poses or priors",
    ELEVATION: "measured relative_poses",
    STRETCH: "measured relative_poses",
    MOTION: "frames at lower speed",
    PAIRS: "measured relative_poses or priors",
    PRIORS: "better measurements of priors and relative_poses",
    LENSES: "a calibration of the lens",
    ESTIMATED: "a calibration of the lens",
    OTHER_LIDARS: "instants at more places, for the LiDARs",
    FLAT: "frames at more places, with walls, poles or vehicles",
}
"""What would shrink an error bar that is mostly of this source."""

_MOST = 0.5  # share of a source that is most of the error bar
_MENTIONED = 0.05  # share of a source that is worth advice


@dataclass(frozen=True)
class ErrorSources:
    """The sources of one camera's error bar, about its worst axis and along its worst axis.

    Attributes:
        rotation_deg, translation_cm: standard deviation about and along the worst axis.
        rotation, translation: share of each source in the variance; they add up to 1.
        forecast: the error bar [deg, cm] with that factor more frames and places.
    """

    rotation_deg: float
    translation_cm: float
    rotation: Mapping[str, float] = field(default_factory=dict)
    translation: Mapping[str, float] = field(default_factory=dict)
    forecast: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def over_tolerance(self, tolerance: tuple[float, float]) -> float:
        """The error bar over the tolerance [deg, cm], the larger of rotation and translation."""
        return max(self.rotation_deg / tolerance[0], self.translation_cm / tolerance[1])

    def describe(self, tolerance: tuple[float, float]) -> str:
        """The error bar that is larger beside the tolerance [deg, cm], and what would shrink it."""
        sigma, _, unit, shares = self._larger(tolerance)
        most = SHRINKS_WITH.get(max(shares, key=shares.__getitem__, default=""), "")
        advice = f" {most[:1].upper()}{most[1:]} would help most." if most else ""
        return f"{in_unit(sigma, unit, 2)} (1 sigma).{advice}"

    def action(self, tolerance: tuple[float, float]) -> str:
        """The action that shrinks the error bar enough for a PASS, in one sentence; empty if it is.

        For a tolerance of rotation [deg] and distance [cm].
        """
        sigma, most, unit, shares = self._larger(tolerance)
        if sigma <= NEEDED * most:
            return ""
        if shares.get(FLAT, 0.0) > _MOST:  # more frames of the same scenes are as flat
            return (
                f"Record {SHRINKS_WITH[FLAT]}: poses {in_unit(sigma, unit, 2)} apart "
                "explain these images almost equally well."
            )
        for source, advice in _ADVICE.items():
            if shares.get(source, 0.0) > _MOST:
                return advice
        enough = [
            times
            for times, (deg, cm) in self.forecast.items()
            if deg <= NEEDED * tolerance[0] and cm <= NEEDED * tolerance[1]
        ]
        if enough and enough[0] < MOST_TIMES:
            places = ", at more places" if shares.get(PLACES, 0.0) > _MENTIONED else ""
            return f"Record {enough[0]} times as many frames{places}."
        best = self.forecast.get(MOST_TIMES, (self.rotation_deg, self.translation_cm))
        least = in_unit(best[0] if unit == "deg" else best[1], unit, 2)
        return (
            "Tolerate more (tolerance_deg, tolerance_cm in --config), or give measured "
            f"relative_poses or priors: {least} of common error remain with any number of frames."
        )

    def _larger(
        self, tolerance: tuple[float, float]
    ) -> tuple[float, float, str, Mapping[str, float]]:
        """Of rotation or translation, which is larger beside its tolerance; that, unit, shares."""
        rotation = self.rotation_deg, tolerance[0], "deg", self.rotation
        translation = self.translation_cm, tolerance[1], "cm", self.translation
        return max(rotation, translation, key=lambda bar: bar[0] / bar[1])
