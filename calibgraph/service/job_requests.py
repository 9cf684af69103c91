"""What jobs are asked for, checked; what their process gets and returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from calibgraph.model.config import Config, Terms, config_from
from calibgraph.service.settings import Settings

JobKind = Literal["calibrate", "solve", "check"]
"""Named as the commands."""

RIG, TABLE, RECORDING = "rig", "correspondences", "recording"
"""Names of inputs: fields of the form, and in the job's folder."""
TEXTS = ("settings", "name", "note")
"""Fields that are no inputs."""

PARTS: Mapping[JobKind, Mapping[str, bool]] = {
    "calibrate": {RECORDING: True, RIG: False, TABLE: False},
    "solve": {RIG: True, TABLE: True},
    "check": {RIG: True, RECORDING: True},
}
"""The inputs of each kind, and whether they are required."""
MAX_RECORDINGS = 100


def _printable(text: object) -> object:
    """A text on one line, without characters that command a terminal or turn text around."""
    if not isinstance(text, str):
        return text
    return "".join(filter(str.isprintable, " ".join(text.split())))


def _checked_config(content: object) -> object:
    """Settings from a mapping, whose preset gives those that it leaves out."""
    return config_from(content, "config") if isinstance(content, Mapping) else content


Frames = Annotated[str, StringConstraints(max_length=10_000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SolveSettings(_Strict):
    """How correspondences are solved.

    Attributes:
        config: settings of the solve, as in a ``--config`` file.
        report: whether to write ``report.html``, which takes longer than a small solve.
    """

    config: Annotated[Config, BeforeValidator(_checked_config)] = Config()
    terms: Terms = "full"
    report: bool = True


class CalibrationSettings(SolveSettings):
    """How a recording is calibrated.

    Attributes:
        frames: which, as ``--frames``: ``0:90:10`` or ``0,5,7``.
        search: whether the guess may be far off.
        search_deg, search_m: how far, per axis; the matcher's default if None.
        time_limit_s: when to stop matching; at most half of the server's limit for a job.
    """

    frames: Frames | None = None
    search: bool = True
    search_deg: Annotated[float, Field(gt=0, le=45)] | None = None
    search_m: Annotated[float, Field(gt=0, le=5)] | None = None
    time_limit_s: Annotated[float, Field(gt=0)] | None = None


class CheckSettings(_Strict):
    """How a deployed calibration is checked.

    Attributes:
        tolerance_deg, tolerance_cm: largest deviation per axis that is OK.
        frames: which, as ``--frames``.
    """

    tolerance_deg: Annotated[float, Field(gt=0, le=180)] = 0.5
    tolerance_cm: Annotated[float, Field(gt=0, le=1000)] = 10.0
    frames: Frames | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


SETTINGS_OF: Mapping[JobKind, type[BaseModel]] = {
    "calibrate": CalibrationSettings, "solve": SolveSettings, "check": CheckSettings,
}  # fmt: skip


class Job(_Strict):
    """A job as it is kept: its URIs by the name of the input; uploads are in its folder."""

    kind: JobKind
    uris: dict[str, Annotated[str, StringConstraints(min_length=1, max_length=2000)]] = {}
    recordings: int = 0
    settings: dict[str, Any] = {}
    name: Annotated[str, StringConstraints(max_length=100), BeforeValidator(_printable)] = ""
    note: Annotated[str, StringConstraints(max_length=2000), BeforeValidator(_printable)] = ""


def recording_name(index: int) -> str:
    """The name of a recording in a job's folder."""
    return f"{RECORDING}_{index}" if index else RECORDING


@dataclass(frozen=True)
class JobTask:
    """A job for a process, with the server's settings, which have its limits."""

    job: Job
    folder: Path
    settings: Settings


class JobProgress(BaseModel):
    """How far a running job is: the stage, and steps of it."""

    model_config = ConfigDict(frozen=True)

    stage: str
    done: int
    total: int
