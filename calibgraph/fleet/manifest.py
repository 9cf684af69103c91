"""Manifests: which vehicles are calibrated, from which recordings, with which settings."""

import hashlib
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv, parquet
from pydantic import Field

from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.fleet.files import SCHEMA, fingerprint, in_arrow, join, read_bytes
from calibgraph.model.config import Config, config_from
from calibgraph.yaml_text import parse_yaml

Key = tuple[str, str]
"""What a job is known by in the rows: vehicle, recordings."""
_SEPARATOR = ";"  # between several recordings in one cell
_OWN = ("vehicle", "recording", "rig", "settings")
_MOST_BYTES = 2**31
_MATCHING = ("frames", "search_deg", "search_m")


class Settings(StrictNumbers):
    """Settings of one job.

    Attributes:
        frames: of a recording, as of ``--frames``.
        search_deg, search_m: how far off the guess may be; 0: no search; None: the default.
    """

    config: Config = Config()
    frames: str | None = None
    search_deg: float | None = Field(default=None, ge=0)
    search_m: float | None = Field(default=None, ge=0)


@dataclass(frozen=True)
class Job:
    """One calibration: a row of the manifest.

    Attributes:
        vehicle: its name.
        recordings: URIs: of one table of correspondences, or of folders of one rig.
        rig: URI of the guess; None: the one that lies with the recording.
        row: number of the manifest's row.
    """

    vehicle: str
    recordings: tuple[str, ...]
    rig: str | None
    settings: Settings
    row: int

    @property
    def recording(self) -> str:
        """The recordings in one text, as in the rows."""
        return _SEPARATOR.join(self.recordings)

    @property
    def key(self) -> Key:
        """What the job is known by."""
        return self.vehicle, self.recording

    @property
    def is_table(self) -> bool:
        """Whether the input is a table of correspondences, by its suffix, also in an archive."""
        return self.recordings[0].partition("::")[0].endswith((".parquet", ".csv"))

    def input_hash(self) -> str:
        """SHA-256 of the rig, the settings and the recordings."""
        parts = [fingerprint(uri) for uri in (*self.recordings, *([self.rig] if self.rig else []))]
        text = json.dumps([self.settings.model_dump(), len(self.recordings), *parts])
        return hashlib.sha256(text.encode()).hexdigest()


def load_manifest(uri: str) -> tuple[list[Job], pa.Table]:
    """The jobs of a manifest, Parquet or CSV, and its further columns, which the results carry.

    Relative paths in it start at its folder.
    """
    table = _read(uri)
    for name, count in Counter(table.column_names).items():
        if count > 1:
            raise FileError(uri, f"column {name!r} is there {count} times; rename or remove one")
        if name in SCHEMA.names and name not in _OWN:
            raise FileError(uri, f"column {name!r} is one of the results' own; rename it")
    for name in ("vehicle", "recording"):
        if name not in table.column_names:
            found = ", ".join(table.column_names)
            raise FileError(uri, f"column {name!r} is missing, found {found}")
    if not len(table):
        raise FileError(uri, "holds no rows; write a vehicle and its recording into each")
    folder, jobs = uri.rpartition("/")[0], dict[Key, Job]()
    cells = table.select([name for name in _OWN if name in table.column_names])
    for row, given in enumerate(cells.to_pylist()):
        try:
            job = _job(row, folder, **{**dict.fromkeys(_OWN), **given})
        except (ValueError, CalibrationError) as error:
            raise FileError(uri, f"row {row}: {error}") from error
        if (first := jobs.setdefault(job.key, job)) is not job:
            raise FileError(
                uri, f"row {row}: vehicle {job.vehicle!r} with this recording is in row "
                f"{first.row} too; remove one"
            )  # fmt: skip
    return [*jobs.values()], table.drop_columns(cells.column_names)


def _read(uri: str) -> pa.Table:
    content = read_bytes(uri, _MOST_BYTES)
    suffix = Path(uri).suffix
    try:
        if suffix == ".parquet":
            table = parquet.read_table(in_arrow(content))
            table.validate(full=True)  # texts may be other bytes
            return table
        if suffix == ".csv":
            strings = csv.ConvertOptions(
                column_types=dict.fromkeys((*_OWN, "model"), pa.string()),
                strings_can_be_null=True,
            )
            return csv.read_csv(in_arrow(content), convert_options=strings)
    except (pa.ArrowException, UnicodeDecodeError, OverflowError) as error:
        raise FileError(uri, f"cannot be read as {suffix[1:]} ({error})") from error
    raise FileError(uri, "the name of a manifest must end in .parquet or .csv")


def _job(row: int, folder: str, *, vehicle: Any, recording: Any, rig: Any, settings: Any) -> Job:
    """A row's job.

    Raises:
        ValueError, FileError: naming the cell that is wrong.
    """
    if not isinstance(vehicle, str) or not vehicle:
        raise ValueError(f"vehicle {vehicle!r}: expected a name; give the column as text")
    if not vehicle.isprintable():
        raise ValueError(f"vehicle {vehicle!r}: has control characters; rename it")
    found = recording.split(_SEPARATOR) if isinstance(recording, str) else []
    if not found or not all(found):
        raise ValueError(f"recording {recording!r}: expected a path or URI, or several between ;")
    if rig is not None and not isinstance(rig, str):
        raise ValueError(f"rig {rig!r}: expected a path or URI")
    recordings = tuple(join(folder, uri.strip()) for uri in found)
    place = join(folder, rig) if rig else None
    job = Job(vehicle, recordings, place, _settings(settings), row)
    if job.is_table and len(recordings) > 1:
        raise ValueError(f"vehicle {vehicle!r}: several tables; write them into one file")
    if job.is_table and not rig:
        raise ValueError(f"vehicle {vehicle!r}: a table of correspondences needs a 'rig'")
    return job


def _settings(cell: Any) -> Settings:
    """Settings from the text of a mapping."""
    if cell is not None and not isinstance(cell, str):
        raise ValueError(f"settings {cell!r}: expected the text of a mapping")
    content = parse_yaml(cell or "{}", "settings")
    matching = {name: content.pop(name) for name in _MATCHING if name in content}
    given = {**matching, "config": config_from(content, "settings")}
    return checked_model(Settings, given, "settings")
