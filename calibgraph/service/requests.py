"""What jobs are asked for, checked; what their process gets and returns; names in their folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from calibgraph.fleet.task import ErrorKind
from calibgraph.model.config import Config, Terms, config_from
from calibgraph.service.places import Root
from calibgraph.service.settings import Settings

JobKind = Literal["calibration", "solve", "check"]

MAX_RECORDINGS = 100
Uri = Annotated[str, StringConstraints(min_length=1, max_length=2000)]
JobName = Annotated[
    str, StringConstraints(max_length=100, strip_whitespace=True, pattern=r"^[^\x00-\x1f]*$")
]
JobNote = Annotated[
    str, StringConstraints(max_length=2000, strip_whitespace=True, pattern=r"^[^\x00]*$")
]
Tolerance = Annotated[float, Field(gt=0, le=180)]


def _checked_config(content: object) -> object:
    """Settings from a mapping, whose preset gives those that it leaves out."""
    return config_from(content, "config") if isinstance(content, Mapping) else content


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

    frames: Annotated[str, StringConstraints(max_length=10_000)] | None = None
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

    tolerance_deg: Tolerance = 0.5
    tolerance_cm: Annotated[float, Field(gt=0, le=1000)] = 10.0
    frames: Annotated[str, StringConstraints(max_length=10_000)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


Recordings = Annotated[tuple[Uri, ...], Field(min_length=1, max_length=MAX_RECORDINGS)]


class _Request(_Strict):
    """What every request may add."""

    name: JobName = ""
    note: JobNote = ""


class CalibrationRequest(_Request):
    """A calibration of recordings that the server can read.

    Attributes:
        recordings: URIs of dataset folders, KITTI sequences or bags of one rig.
        rig: URI of the guess; None: the one that lies with the data.
        correspondences: URI of a table to take in place of matching.
        settings: see there.
    """

    recordings: Recordings
    rig: Uri | None = None
    correspondences: Uri | None = None
    settings: CalibrationSettings = CalibrationSettings()


class SolveRequest(_Request):
    """A solve of a table that the server can read.

    Attributes:
        rig: URI of the guess.
        correspondences: URI of the table.
        settings: see there.
    """

    rig: Uri
    correspondences: Uri
    settings: SolveSettings = SolveSettings()


class CheckRequest(_Request):
    """A check of a deployed calibration with recordings that the server can read.

    Attributes:
        rig: URI of the deployed calibration.
        recordings: URIs of recent recordings.
        settings: see there.
    """

    rig: Uri
    recordings: Recordings
    settings: CheckSettings = CheckSettings()


AnyRequest = CalibrationRequest | SolveRequest | CheckRequest
REQUESTS: Mapping[JobKind, type[AnyRequest]] = {
    "calibration": CalibrationRequest,
    "solve": SolveRequest,
    "check": CheckRequest,
}


class Job(_Request):
    """A job as it is kept: its URIs by the name of the input; uploads are in its folder."""

    kind: JobKind
    uris: dict[str, str] = {}
    recordings: int = 0
    settings: dict[str, Any] = {}


RIG, TABLE, RECORDING = "rig", "correspondences", "recording"
"""Names of inputs: the files of an upload, and in the job's folder."""
ABOUT = ("name", "note")
"""Names of texts for people."""

_INPUTS = {"recordings": RECORDING, "rig": RIG, "correspondences": TABLE}
ALLOWED: Mapping[JobKind, tuple[str, ...]] = {
    kind: tuple(_INPUTS[name] for name in model.model_fields if name in _INPUTS)
    for kind, model in REQUESTS.items()
}
REQUIRED: Mapping[JobKind, tuple[str, ...]] = {
    kind: tuple(_INPUTS[name] for name, field in model.model_fields.items()
                if name in _INPUTS and field.is_required())
    for kind, model in REQUESTS.items()
}  # fmt: skip
SETTINGS_OF: Mapping[JobKind, type[SolveSettings] | type[CheckSettings]] = {
    kind: type(model.model_fields["settings"].default) for kind, model in REQUESTS.items()
}
"""The models of the settings."""


def job_of(request: AnyRequest, kind: JobKind) -> Job:
    """The job that a JSON body asks for."""
    uris: dict[str, str] = {}
    recordings: tuple[str, ...] = getattr(request, "recordings", ())
    for name in (RIG, TABLE):
        if uri := getattr(request, name, None):
            uris[name] = uri
    uris |= {recording_name(i): uri for i, uri in enumerate(recordings)}
    settings = request.settings.model_dump(mode="json")
    return Job(
        kind=kind,
        uris=uris,
        recordings=len(recordings),
        settings=settings,
        name=request.name,
        note=request.note,
    )


def recording_name(index: int) -> str:
    """The name of a recording in a job's folder."""
    return f"{RECORDING}_{index}" if index else RECORDING


INPUT, WORK, RESULT, LOG = "input", "work", "result", "log.txt"
"""In a job's folder: its input, its result while it is written, its result, its log."""
FILES, SUMMARY = "files", "summary.json"
"""In the result: the files that the command writes, and the summary that it prints."""


@dataclass(frozen=True)
class JobTask:
    """A job for a process, with the server's settings, which have its limits."""

    job: Job
    folder: Path
    roots: tuple[Root, ...]
    settings: Settings


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended: the verdict of its result, or why it failed, in one line."""

    verdict: str | None = None
    cannot_tell: bool | None = None
    error_kind: ErrorKind | None = None
    error: str | None = None


class JobProgress(BaseModel):
    """How far a running job is.

    Attributes:
        stage: what it does.
        done, total: steps of the stage.
    """

    model_config = ConfigDict(frozen=True)

    stage: str
    done: int
    total: int
