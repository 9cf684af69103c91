"""The forms of the pages: what a browser may give with a new job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from calibgraph.service.requests import JobKind

TITLES: Mapping[JobKind, str] = {
    "calibration": "Calibrate a recording",
    "check": "Check a deployed calibration",
    "solve": "Solve a table of correspondences",
}


@dataclass(frozen=True)
class Field:
    """An input of a form; its type is that of HTML's inputs, or textarea."""

    name: str
    label: str
    hint: str = ""
    type: str = "text"
    required: bool = False
    multiple: bool = False


_ABOUT = (
    Field("name", "Name", "For the list of jobs."),
    Field("note", "Note", type="textarea"),
)
_RECORDING = Field(
    "recording", "Recording", "A zip of a dataset folder, or bags.", "file", True, True
)
_RIG = Field("rig", "Guess", "A rig.yaml; without one, that of the recording.", "file")
_FRAMES = Field("frames", "Frames", "Like 0:90:10; without, all or the best 30.")
_FIELDS: Mapping[JobKind, tuple[Field, ...]] = {
    "calibration": (
        _RECORDING,
        _RIG,
        *_ABOUT,
        _FRAMES,
        Field("search_deg", "Search range, deg per axis", "Without, the matcher's.", "number"),
        Field("search_m", "Search range, m per axis", "Without, the matcher's.", "number"),
    ),
    "check": (
        replace(_RIG, label="Deployed calibration", hint="A rig.yaml or calibration.yaml.",
                required=True),
        _RECORDING,
        *_ABOUT,
        Field("tolerance_deg", "Tolerance, deg per axis", "Without, 0.5.", "number"),
        Field("tolerance_cm", "Tolerance, cm per axis", "Without, 10.", "number"),
        _FRAMES,
    ),
    "solve": (
        replace(_RIG, hint="A rig.yaml.", required=True),
        Field("correspondences", "Correspondences", "A .parquet or .csv.", "file", True),
        *_ABOUT,
    ),
}  # fmt: skip


def form_of(kind: JobKind) -> dict[str, Any]:
    """What the template of a new job's page shows."""
    return {"kind": kind, "title": TITLES[kind], "kinds": TITLES.items(), "fields": _FIELDS[kind]}
