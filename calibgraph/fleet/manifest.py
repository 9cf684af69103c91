"""Manifests: which vehicles are calibrated, from which recordings, with which settings."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv, parquet
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import checked_model
from calibgraph.fleet.rows import SCHEMA
from calibgraph.fleet.uris import fingerprint, in_arrow, join, read_bytes
from calibgraph.model.config import Config, Terms, config_from
from calibgraph.yaml_text import parse_yaml

TABLE_SUFFIXES = (".parquet", ".csv")
SEPARATOR = ";"
"""Between several recordings in one cell."""
_OWN = ("vehicle", "recording", "rig", "settings")
_MOST_BYTES, _MOST_SETTINGS_BYTES = 2**31, 2**20
_MATCHING = ("frames", "search_deg", "search_m", "terms")


def is_table(uri: str) -> bool:
    """Whether a URI is of a table of correspondences, by its suffix; it may be in an archive."""
    return uri.partition("::")[0].endswith(TABLE_SUFFIXES)


class Settings(BaseModel):
    """Settings of one job.

    Attributes:
        frames: of a recording, as of ``--frames``.
        search_deg, search_m: how far off the guess may be; None: the matcher's default.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    config: Config = Config()
    terms: Terms = "full"
    frames: str | None = None
    search_deg: float | None = Field(default=None, gt=0)
    search_m: float | None = Field(default=None, gt=0)


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
        return SEPARATOR.join(self.recordings)

    @property
    def key(self) -> tuple[str, str]:
        """What the job is known by in the rows."""
        return self.vehicle, self.recording

    @property
    def is_table(self) -> bool:
        """Whether the input is a table of correspondences."""
        return is_table(self.recordings[0])

    def input_hash(self) -> str:
        """SHA-256 of the rig, the settings and the recordings."""
        parts = [fingerprint(uri) for uri in (*self.recordings, *([self.rig] if self.rig else []))]
        text = json.dumps([self.settings.model_dump(), len(self.recordings), *parts])
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Manifest:
    """The jobs of a manifest, and its further columns, which the rows of results carry."""

    uri: str
    jobs: tuple[Job, ...]
    others: pa.Table


def load_manifest(uri: str) -> Manifest:
    """Read a manifest, Parquet or CSV; relative paths in it start at its folder."""
    table = _read(uri)
    for name, count in Counter(table.column_names).items():
        if count > 1:
            raise FileError(uri, f"column {name!r} is there {count} times; rename or remove one")
    for name in ("vehicle", "recording"):
        if name not in table.column_names:
            raise FileError(
                uri, f"column {name!r} is missing, found {', '.join(table.column_names)}"
            )
    taken = {*SCHEMA.names, "bucket"} - {*_OWN}
    for name in table.column_names:
        if name in taken:
            raise FileError(uri, f"column {name!r} is one of the results' own; rename it")
    if not len(table):
        raise FileError(uri, "holds no rows; write a vehicle and its recording into each")
    folder, seen, jobs = uri.rpartition("/")[0], dict[tuple[str, str], int](), []
    cells = table.select([name for name in _OWN if name in table.column_names])
    for row, given in enumerate(cells.to_pylist()):
        try:
            job = _job(row, folder, **{**dict.fromkeys(_OWN), **given})
        except (ValueError, CalibrationError) as error:
            raise FileError(uri, f"row {row}: {error}") from error
        if (first := seen.setdefault(job.key, row)) != row:
            raise FileError(
                uri, f"row {row}: vehicle {job.vehicle!r} with this recording is in row {first} "
                "too; remove one"
            )  # fmt: skip
        jobs.append(job)
    return Manifest(uri, tuple(jobs), table.drop_columns(cells.column_names))


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
                column_types=dict.fromkeys((*_OWN, "model", "batch"), pa.string()),
                strings_can_be_null=True,
            )
            return csv.read_csv(in_arrow(content), convert_options=strings)
    except (pa.ArrowException, UnicodeDecodeError, OverflowError) as error:
        raise FileError(uri, f"cannot be read as {suffix[1:]} ({error})") from error
    raise FileError(uri, "the name of a manifest must end in .parquet or .csv")


def _job(row: int, folder: str, *, vehicle: Any, recording: Any, rig: Any, settings: Any) -> Job:
    """A row's job.

    Raises:
        ValueError, FileError: naming the cell that is wrong, or the file of settings.
    """
    if not isinstance(vehicle, str) or not vehicle:
        raise ValueError(f"vehicle {vehicle!r}: expected a name; give the column as text")
    if not vehicle.isprintable():
        raise ValueError(f"vehicle {vehicle!r}: has control characters; rename it")
    found = recording.split(SEPARATOR) if isinstance(recording, str) else recording
    if not isinstance(found, list) or not found or not all(u and isinstance(u, str) for u in found):
        raise ValueError(f"recording {recording!r}: expected a path or URI, or several between ;")
    recordings = tuple(join(folder, uri.strip()) for uri in found)
    if is_table(recordings[0]) and len(recordings) > 1:
        raise ValueError(f"vehicle {vehicle!r}: several tables; write them into one file")
    if is_table(recordings[0]) and not rig:
        raise ValueError(f"vehicle {vehicle!r}: a table of correspondences needs a 'rig'")
    if rig is not None and not isinstance(rig, str):
        raise ValueError(f"rig {rig!r}: expected a path or URI")
    place = join(folder, rig) if rig else None
    return Job(vehicle, recordings, place, _settings(folder, settings), row)


def _settings(folder: str, cell: Any) -> Settings:
    """Settings from a mapping, its text, or the URI of a YAML file."""
    if isinstance(cell, Mapping):  # a struct of Arrow has null for what a row leaves out
        given = {name: value for name, value in cell.items() if value is not None}
        return _checked(given, "settings")
    if cell and not isinstance(cell, str):
        raise ValueError(f"settings {cell!r}: expected a mapping, or the URI of a YAML file")
    if not cell or cell.lstrip().startswith("{"):
        return _checked(parse_yaml(cell or "{}", "settings"), "settings")
    uri = join(folder, cell)
    try:
        text = read_bytes(uri, _MOST_SETTINGS_BYTES).decode()
    except UnicodeDecodeError as error:
        raise FileError(uri, f"is not a text file ({error.reason})") from error
    return _checked(parse_yaml(text, uri), uri)


def _checked(content: Mapping[str, Any], where: str) -> Settings:
    matching = {name: value for name, value in content.items() if name in _MATCHING}
    config = {name: value for name, value in content.items() if name not in _MATCHING}
    return checked_model(Settings, {**matching, "config": config_from(config, where)}, where)
