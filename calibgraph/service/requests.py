"""Settings of the server; what jobs are asked for, checked; what their process gets and returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from calibgraph.files import StrictNumbers
from calibgraph.model.config import Config, Terms, config_from
from calibgraph.parallel import count_cores

JobKind = Literal["calibrate", "solve", "check"]
"""Named as the commands."""

RIG, TABLE, RECORDING = "rig", "correspondences", "recording"
"""Names of inputs: fields of the form, and in the job's folder."""
TEXTS = ("settings", "name")
"""Fields that are no inputs."""

PARTS: Mapping[JobKind, Mapping[str, bool]] = {
    "calibrate": {RECORDING: True, RIG: False, TABLE: False},
    "solve": {RIG: True, TABLE: True},
    "check": {RIG: True, RECORDING: True},
}
"""The inputs of each kind, and whether they are required."""
MAX_RECORDINGS = 100

INPUT, SCRATCH, WORK, RESULT, LOG = "input", "scratch", "work", "result", "log.txt"
"""In a job's folder: its input, its working folder, its result as it is written, then; its log."""

FILES, ARCHIVE, SUMMARY = "files", "files.zip", "summary.json"
"""In the result: the files that the command writes, all of them, the summary that it prints."""


def _printable(text: object) -> object:
    """A text on one line, without characters that command a terminal or turn text around."""
    if not isinstance(text, str):
        return text
    return "".join(filter(str.isprintable, " ".join(text.split())))


Frames = Annotated[str, StringConstraints(max_length=10_000)]


class SolveSettings(StrictNumbers):
    """How correspondences are solved.

    Attributes:
        config: settings of the solve, as in a ``--config`` file.
        report: whether to write ``report.html``, which takes longer than a small solve.
    """

    config: Annotated[
        Config,  # of a mapping the preset gives those that it leaves out
        BeforeValidator(lambda c: config_from(c, "config") if isinstance(c, Mapping) else c),
    ] = Config()
    terms: Terms = "full"
    report: bool = True


class CalibrationSettings(SolveSettings):
    """How a recording is calibrated.

    Attributes:
        frames: which, as ``--frames``: ``0:90:10`` or ``0,5,7``.
        search_deg, search_m: how far off the guess may be, per axis; 0: no search, None: the
            matcher's default.
        time_limit_s: when to stop matching; at most half of the server's limit for a job.
    """

    frames: Frames | None = None
    search_deg: Annotated[float, Field(ge=0, le=45)] | None = None
    search_m: Annotated[float, Field(ge=0, le=5)] | None = None
    time_limit_s: Annotated[float, Field(gt=0)] | None = None


class CheckSettings(StrictNumbers):
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


class Job(StrictNumbers):
    """A job as it is kept; its uploads are in its folder."""

    kind: JobKind
    recordings: int = 0
    settings: dict[str, Any] = {}
    name: Annotated[str, StringConstraints(max_length=100), BeforeValidator(_printable)] = ""


def recording_name(index: int) -> str:
    """The name of a recording in a job's folder."""
    return f"{RECORDING}_{index}" if index else RECORDING


class JobProgress(BaseModel):
    """How far a running job is: the stage, and steps of it."""

    model_config = ConfigDict(frozen=True)

    stage: str
    done: int
    total: int


MB, GB = 10**6, 10**9
Bytes = Annotated[int, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Seconds = Annotated[float, Field(gt=0)]


class Settings(StrictNumbers):
    """Settings of a server.

    Attributes:
        data: folder for jobs and trackers, of one server at a time.
        tokens: file of the tokens that may call; None: anyone on this machine may.
        hosts: names by which the server is called; others are refused. Empty: without a token file
            the names of this machine for itself, else any.
        jobs_at_once: child processes for jobs.
        most_queued: jobs that wait; further ones are refused for the time being.
        job_timeout_s: longest time of a job.
        memory_bytes: that a job, or a process with trackers, may allocate.
        recording_bytes: most bytes of an upload, packed and unpacked.
        free_bytes: of the disk; with less, nothing is accepted.
        keep_s: how long the results of finished jobs are kept.
        tracker_processes: that hold the trackers; they start with the first.
        body_bytes: most bytes of a body that is no upload: frames of a tracker.
        grace_s: how long jobs may run on when the server is told to stop.
    """

    data: Path
    tokens: Path | None = None
    hosts: tuple[str, ...] = ()
    jobs_at_once: Count = Field(default_factory=count_cores)
    most_queued: Count = 1000
    job_timeout_s: Seconds = 3600.0
    memory_bytes: Bytes = 8 * GB
    recording_bytes: Bytes = 20 * GB
    free_bytes: Count = 1 * GB
    keep_s: Seconds = 30 * 86400.0
    tracker_processes: Annotated[int, Field(ge=1)] = 2
    body_bytes: Bytes = 16 * MB
    grace_s: Seconds = 10.0


@dataclass(frozen=True)
class JobTask:
    """A job for a process, with the server's settings, which have its limits."""

    job: Job
    folder: Path
    settings: Settings
