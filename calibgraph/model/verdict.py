"""Checks, and the verdict: a cut of the probability that a result is off, or the worst check."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

Status = Literal["PASS", "WARN", "FAIL"]

_ORDER: tuple[Status, ...] = ("PASS", "WARN", "FAIL")
PASS_BELOW, FAIL_ABOVE = 0.005, 0.2
"""Probabilities that a result is off by more than the tolerance, where verdicts are cut."""
TOLERANCE = (0.5, 10.0)
"""Rotation [deg] and distance [cm] that users tolerate if they state nothing else."""
START = "start"
"""Kind of the check of a tracked camera that has no estimate yet."""
COMMON_ERROR = "common_error"
"""Kind of the check that a table states the error that its frames share."""
ABOUT_THE_DATA = frozenset({
    COMMON_ERROR, START, "copies", "correspondences", "correspondences_used",
    "failed_frames", "frames", "image evidence", "images", "lidar_instants", "lidar_loose",
    "lidar_start", "no_error_bar", "repeated_frames", "sigma_rotation",
    "sigma_translation", "terms", "went_on",
    "beyond_tolerance", "difference between even and odd frames", "focal_sensitivity",
    "prior_share",
})  # fmt: skip
"""Kinds of checks that count data: beyond a limit, nothing seems wrong yet. The last line is of
results of earlier versions."""
WENT_ON = "went_on"
"""Kind of the check of a camera whose pose was chosen by the images' posterior: it does not fail,
and keeps from a PASS, since the same posterior cannot vouch for it."""
FLAT_EVIDENCE = "flat_evidence"
"""Kind of the check that compares the error bars by images and by matches. The wider one is in the
result, so that the check itself changes no verdict."""
ERROR_BAR = frozenset({FLAT_EVIDENCE, "sigma_rotation", "sigma_translation"})
"""Kinds of checks of the error bar: they decide nothing where the probability of an error, which
has the bar, is known."""
BRIGHTNESS = "brightness of the images"
"""Kind of the check that explains all others of a camera: its images show too little."""
IMAGES_ELSEWHERE = "images"
"""Kind of the check that the images of a table were compared with another pose, lens or time."""
_SURE, _LEAST = 0.99, 0.001  # beyond these, probabilities are not known


@dataclass(frozen=True)
class Check:
    """One check of one camera's result.

    Attributes:
        name: of the measured number, or of the search.
        status: PASS, WARN or FAIL.
        text: one sentence: what was found and, if that is not PASS, what to do.
        value: the number that was found, if it is one.
        warn: the limit of PASS, which itself passes, if there is one.
        fail: the limit of WARN, which itself does not fail, if there is one.
        unit: of value, warn and fail.
        kind: the same for all cameras and numbers; the name if it is empty.
    """

    name: str
    status: Status
    text: str
    value: float | None = None
    warn: float | None = None
    fail: float | None = None
    unit: str = ""
    kind: str = ""

    @property
    def decisive(self) -> bool:
        """Whether it is a FAIL without limits: nothing was measured, or something did not work."""
        return self.status == "FAIL" and self.warn is None

    @property
    def is_graded(self) -> bool:
        """Whether the status is the one that the limits give the value."""
        if self.value is None or self.warn is None or self.fail is None:
            return False
        return self.status == grade(self.value, self.warn, self.fail)

    @property
    def severity(self) -> float:
        """How bad it is: 0 to 1 is PASS, 1 to 2 WARN, 2 to 3 FAIL, without steps at the limits."""
        low = float(_ORDER.index(self.status))
        if self.value is None or self.warn is None or self.fail is None:
            return low + 0.5 if low else 0.0
        if math.isnan(self.value):
            return low + 1.0
        return float(min(max(_between(self.value, self.warn, self.fail), low), low + 1.0))


def _between(value: float, warn: float, fail: float) -> float:
    """Severity of a value: below 1 before the PASS limit, 2 at the WARN limit, 3 far beyond it.

    Which side is good is seen from the limits; of equal ones, or of one without a FAIL limit, the
    share of the first limit counts.
    """
    at_most = warn <= fail
    before, beyond = (value <= warn, value > fail) if at_most else (value >= warn, value < fail)
    if before:
        return _share(value, warn) if at_most else _share(warn, value)
    if beyond:
        return 3.0 - (_share(fail, value) if at_most else _share(value, fail))
    if math.isinf(fail):
        return 2.0 - _share(warn, value)
    return 1.0 + (value - warn) / (fail - warn)


def _share(part: float, whole: float) -> float:
    """A ratio of two numbers of one sign, 0 to 1; else 0."""
    return min(max(part / whole, 0.0), 1.0) if whole and math.isfinite(whole) else 0.0


@dataclass(frozen=True)
class ErrorProbability:
    """The probability that a result is off by more than the tolerance, from two sources.

    Attributes:
        by_checks: that it is grossly wrong.
        by_error_bar: that its error bar allows more than the tolerance.
        bar_odds: factor of the odds of the second, as it held in cases with a known truth.
    """

    by_checks: float
    by_error_bar: float = 0.0
    tolerance_deg: float = TOLERANCE[0]
    tolerance_cm: float = TOLERANCE[1]
    bar_odds: float = 1.0

    @property
    def probability(self) -> float:
        """The probability of either."""
        within = 1.0 - self.by_error_bar
        odds = self.bar_odds * self.by_error_bar
        return 1.0 - (1.0 - self.by_checks) * within / (within + odds)

    @property
    def status(self) -> Status:
        """PASS, WARN or FAIL; a wide error bar alone is a FAIL only if an error is sure."""
        if self.probability > _SURE or not self.by_checks <= FAIL_ABOVE:
            return "FAIL"
        return "PASS" if self.probability < PASS_BELOW else "WARN"

    @property
    def percent(self) -> str:
        """The probability in percent, with its unit."""
        if self.probability > _SURE:
            return f"over {_SURE:.0%}"
        if self.probability < _LEAST:
            return f"<{_LEAST:.1%}"
        return f"{100 * self.probability:{'.1f' if self.probability < 1 - _SURE else '.2g'}}%"

    @property
    def tolerance(self) -> tuple[float, float]:
        """Rotation [deg] and distance [cm]."""
        return self.tolerance_deg, self.tolerance_cm

    @property
    def tolerated(self) -> str:
        """The tolerance with its units."""
        return f"{self.tolerance_deg:g} deg or {self.tolerance_cm:g} cm"

    @property
    def sentence(self) -> str:
        """The event that the probability is about, without the number."""
        return f"off by more than {self.tolerated} with a probability"

    @property
    def of_error_bar(self) -> bool:
        """Whether a wide error bar, rather than checks, keeps it from a PASS."""
        by_bar = self.by_checks <= min(self.by_error_bar, FAIL_ABOVE)
        return self.status != "PASS" and by_bar


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used.

    Attributes:
        checks: all checks, in order.
        error_probability: that the result is off by more than the tolerance; None while driving,
            where the checks alone decide.
        cameras: the verdicts of the cameras, if this is a rig's.
    """

    checks: tuple[Check, ...] = ()
    error_probability: ErrorProbability | None = None
    cameras: tuple[Verdict, ...] = ()

    @cached_property
    def status(self) -> Status:
        """That of the probability; a check that data are missing, or a FAIL, turns PASS into WARN.

        Without a probability, the worst status of the checks; PASS without any.
        """
        statuses = (c.status for c in self.checks if c.kind != FLAT_EVIDENCE)
        worst: Status = max(statuses, key=_ORDER.index, default="PASS")
        if self.error_probability is None:
            return worst
        unmeasured = not self._kinds_beyond.isdisjoint(ABOUT_THE_DATA)
        if self.error_probability.status == "PASS" and (unmeasured or worst == "FAIL"):
            return "WARN"
        return self.error_probability.status

    @property
    def images_note(self) -> str:
        """A sentence on error bars that no images have tested; empty if they have."""
        if any(check.kind == FLAT_EVIDENCE for check in self.checks):
            return ""
        return " No images tested it: over grass and other flat scenes errors can be larger."

    @property
    def percent(self) -> str:
        """The probability that it is off; "-" without one, or where data for one are missing."""
        found = self.error_probability
        known = found is not None and (found.status, self.status) != ("PASS", "WARN")
        return found.percent if found and known else "-"

    @property
    def _kinds_beyond(self) -> set[str]:
        """The kinds of the checks that are beyond a limit, but for those that decide nothing."""
        beyond = {check.kind or check.name for check in self.checks if check.status != "PASS"}
        return beyond - (ERROR_BAR if self.error_probability else {FLAT_EVIDENCE})

    @property
    def cannot_tell(self) -> bool:
        """Whether it is WARN because the data determine too little, not because something is odd.

        True if the error bar is more likely than the checks to hide an error, or if the only checks
        beyond a limit measure how much the data determine. For a rig: if it is true for every
        camera that is not PASS.
        """
        if self.status != "WARN":
            return False
        if self.cameras:
            return all(each.cannot_tell for each in self.cameras if each.status != "PASS")
        if self.error_probability is not None and self.error_probability.of_error_bar:
            return True
        return bool(self._kinds_beyond) and self._kinds_beyond <= ABOUT_THE_DATA

    @property
    def reasons(self) -> tuple[str, ...]:
        """If it is not PASS, the probability; the checks that are not PASS, the worst first."""
        failing = [check for check in self.checks if check.status != "PASS"]
        failing.sort(key=lambda check: -check.severity)
        texts = [check.text for check in failing]
        if self.error_probability is None or self.error_probability.status == "PASS":
            return tuple(texts)
        found = self.error_probability
        wide = ": the error bar is too wide" if found.of_error_bar else ""
        return (f"{found.sentence} of {found.percent}{wide}", *texts)

    def to_mapping(self) -> dict[str, Any]:
        """As plain values, without the checks."""
        return {
            "status": self.status,
            "cannot_tell": self.cannot_tell,
            "error_probability": self.error_probability and vars(self.error_probability),
            "reasons": list(self.reasons),
        }


def rig_verdict(cameras: Mapping[str, Verdict]) -> Verdict:
    """The verdict of a rig: its worst camera's, with the checks of all, named by their cameras."""
    checks = tuple(
        replace(check, text=f"{name}: {check.text}")
        for name, verdict in cameras.items()
        for check in verdict.checks
    )
    known = [each.error_probability for each in cameras.values() if each.error_probability]
    worst = max(known, key=lambda found: (found.status == "FAIL", found.probability), default=None)
    return Verdict(checks, worst, tuple(cameras.values()))


def grade(value: float, warn: float, fail: float) -> Status:
    """PASS, WARN or FAIL by the limits of a value, whose order gives the side; NaN fails."""
    if warn > fail:
        value, warn, fail = -value, -warn, -fail
    return "PASS" if value <= warn else "WARN" if value <= fail else "FAIL"


_CELL = 7  # characters of a number, of which eight and a name fit on 80 columns
_LARGEST = {"share": 1.0, "deg": 180.0}  # that a value can be


@dataclass(frozen=True)
class Threshold:
    """The limits of one measured number: a row of the table in ``trust.thresholds``.

    Attributes:
        key: by which checks look the row up.
        name: of the measured number and its check.
        warn: the last value that is PASS; smaller ones are, too, if it is below the next limit,
            else larger ones.
        fail: the last value that is not FAIL.
        unit: of the values; "share" is printed in percent.
        question: what the check answers, in words.
        advice: the meaning if it is not PASS; for what to do, see ``model.causes``.
        of_tolerance: whether the limits are for the default tolerance, and scale with another one.
    """

    key: str
    name: str
    warn: float
    fail: float
    unit: str
    question: str
    advice: str = ""
    of_tolerance: bool = False

    def at(self, tolerance: tuple[float, float]) -> Threshold:
        """The row for a tolerance [deg, cm].

        A tolerance below the default moves the limit of PASS alone: an error of that size is too
        large for the user, but no sign of a wrong result.
        """
        if not self.of_tolerance:
            return self
        unit = ("deg", "cm").index(self.unit)
        ratio = tolerance[unit] / TOLERANCE[unit]
        return replace(self, warn=self.warn * ratio, fail=self.fail * max(ratio, 1.0))

    def grade(self, value: float) -> Status:
        """PASS, WARN or FAIL of a value; NaN fails."""
        return grade(value, self.warn, self.fail)

    def check(
        self,
        value: float,
        text: str = "",
        *,
        name: str = "",
        advice: str = "",
        status: Status | None = None,
    ) -> Check:
        """The check of a value; if it is not PASS, the advice follows its sentence.

        ``text`` is its own sentence, in place of one of value and limit.
        """
        status, name, advice = status or self.grade(value), name or self.name, advice or self.advice
        if not text:
            limit = self.fail if status == "FAIL" else self.warn
            text = f"{name}: {beside(value, limit, self.unit)}"
            if status != "PASS":
                side = "above" if self.warn <= self.fail else "below"
                text += f", {side} the limit {in_unit(limit, self.unit)}"
        text += f": {advice}" if advice and status != "PASS" else ""
        return Check(name, status, text, float(value), self.warn, self.fail, self.unit, self.key)


def is_reachable(limit: float, unit: str, sign: str) -> bool:
    """Whether a value can be > or < a limit: no count is negative, a share of a score may be."""
    if sign == ">":
        return limit < _LARGEST.get(unit, math.inf)
    return limit > 0 or unit == "share"


def in_unit(value: float, unit: str, digits: int = 3) -> str:
    """A number with its unit, for display; large ones without an exponent."""
    scaled, sign = (100 * value, "%") if unit == "share" else (value, f" {unit}".rstrip())
    if 10**digits <= abs(scaled) < math.inf:
        return f"{scaled:.0f}{sign}"
    return f"{scaled:.{digits}g}{sign}"


def fixed(value: float, decimals: int, sign: str = "") -> str:
    """A number for a cell, of at most seven characters: a large one has fewer decimals."""
    texts = (f"{value:{sign}.{places}f}" for places in range(decimals, -1, -1))
    return next((text for text in texts if len(text) <= _CELL), f"{value:{sign}.0e}")


def beside(value: float, limit: float, unit: str) -> str:
    """A number with its unit, in three digits that tell it from a limit beyond which it lies.

    Where these would be the same, the number is rounded away from the limit.
    """
    text = in_unit(value, unit)
    if value == limit or text != in_unit(limit, unit):
        return text
    scaled = 100 * limit if unit == "share" else limit
    step = 10.0 ** min(math.floor(math.log10(abs(scaled))) - 2, 0)
    away = round(scaled / step) + (1 if value > limit else -1)
    return in_unit(away * step / (100 if unit == "share" else 1), unit)
