"""Manifests: which vehicles are calibrated, from which recordings, with which settings."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv, parquet
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.errors import FileError
from calibgraph.files import checked_model
from calibgraph.fleet.rows import SCHEMA, bucket_of
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
    def bucket(self) -> int:
        """See :func:`calibgraph.fleet.rows.bucket_of`."""
        return bucket_of(self.vehicle)

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
    """Read a manifest: Parquet, CSV or YAML; relative paths in it start at its folder."""
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
    given = [table[name].to_pylist() if name in table.column_names else [None] * len(table)
             for name in _OWN]  # fmt: skip
    folder, files = uri.rpartition("/")[0], dict[str, Any]()
    jobs = tuple(
        _job(_Place(uri, row), folder, files, **dict(zip(_OWN, cells, strict=True)))
        for row, cells in enumerate(zip(*given, strict=True))
    )
    _require_different(uri, jobs)
    return Manifest(uri, jobs, table.drop_columns([n for n in _OWN if n in table.column_names]))


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
        if suffix in (".yaml", ".yml"):
            return _from_yaml(uri, content)
    except (pa.ArrowException, UnicodeDecodeError, OverflowError) as error:
        raise FileError(uri, f"cannot be read as {suffix[1:]} ({error})") from error
    raise FileError(uri, "the name of a manifest must end in .parquet, .csv or .yaml")


def _from_yaml(uri: str, content: bytes) -> pa.Table:
    """The table under the key ``vehicles``."""
    rows = parse_yaml(content.decode(), uri).get("vehicles")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise FileError(uri, "expected the key 'vehicles' with a list of mappings, one per vehicle")
    columns = dict.fromkeys(str(name) for row in rows for name in row)
    cells = {name: [row.get(name) for row in rows] for name in columns}
    for name in set(cells) & {"recording", "settings"}:  # lists and mappings, beside texts
        cells[name] = [json.dumps(cell) if isinstance(cell, (list, dict)) else cell
                       for cell in cells[name]]  # fmt: skip
    return pa.table(cells)


@dataclass(frozen=True)
class _Place:
    """A row of a manifest, in messages."""

    uri: str
    row: int

    def error(self, message: str) -> FileError:
        return FileError(self.uri, f"row {self.row}: {message}")


def _job(
    place: _Place, folder: str, files: dict[str, Any], *, vehicle: Any, recording: Any, rig: Any,
    settings: Any,
) -> Job:  # fmt: skip
    """A row's job; ``files`` keeps the settings' files that were read."""
    if not isinstance(vehicle, str) or not vehicle:
        raise place.error(f"vehicle {vehicle!r}: expected a name; give the column as text")
    if not vehicle.isprintable():
        raise place.error(f"vehicle {vehicle!r}: has control characters; rename it")
    recordings = tuple(join(folder, uri) for uri in _recordings(place, recording))
    if is_table(recordings[0]):
        if len(recordings) > 1:
            raise place.error(f"vehicle {vehicle!r}: several tables; write them into one file")
        if not rig:
            raise place.error(f"vehicle {vehicle!r}: a table of correspondences needs a 'rig'")
    if rig is not None and not isinstance(rig, str):
        raise place.error(f"rig {rig!r}: expected a path or URI")
    return Job(
        vehicle=vehicle,
        recordings=recordings,
        rig=join(folder, rig) if rig else None,
        settings=_settings(place, folder, files, settings),
        row=place.row,
    )


def _recordings(place: _Place, cell: Any) -> Sequence[str]:
    """The URIs in a cell: a list, its JSON, or texts between separators."""
    found = cell
    if isinstance(cell, str):
        found = _json(place, cell) if cell.startswith("[") else cell.split(SEPARATOR)
        found = [text.strip() if isinstance(text, str) else text for text in found]
    if not isinstance(found, list) or not found or not all(u and isinstance(u, str) for u in found):
        raise place.error(f"recording {cell!r}: expected a path or URI, or several between ;")
    return found


def _json(place: _Place, text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise place.error(f"{text!r} is no JSON ({error})") from error


def _settings(place: _Place, folder: str, files: dict[str, Any], cell: Any) -> Settings:
    """Settings from a mapping, its text, or the URI of a YAML file."""
    if not cell:
        return Settings()
    if isinstance(cell, str) and not cell.lstrip().startswith("{"):
        uri = join(folder, cell)
        if uri not in files:
            files[uri] = _checked_settings(parse_yaml(_text(uri), uri), uri)
        found: Settings = files[uri]
        return found
    where = f"{place.uri}: row {place.row}: settings"
    content = parse_yaml(cell, where) if isinstance(cell, str) else cell
    if isinstance(content, Mapping):  # a struct of Arrow has null for what a row leaves out
        content = {name: value for name, value in content.items() if value is not None}
        return _checked_settings(content, where)
    raise place.error(f"settings {cell!r}: expected a mapping, or the URI of a YAML file")


def _text(uri: str) -> str:
    try:
        return read_bytes(uri, _MOST_SETTINGS_BYTES).decode()
    except UnicodeDecodeError as error:
        raise FileError(uri, f"is not a text file ({error.reason})") from error


def _checked_settings(content: dict[str, Any], where: str) -> Settings:
    matching = {name: value for name, value in content.items() if name in _MATCHING}
    config = {name: value for name, value in content.items() if name not in _MATCHING}
    return checked_model(Settings, {**matching, "config": config_from(config, where)}, where)


def _require_different(uri: str, jobs: Sequence[Job]) -> None:
    seen: dict[tuple[str, str], int] = {}
    for job in jobs:
        first = seen.setdefault((job.vehicle, job.recording), job.row)
        if first != job.row:
            raise FileError(
                uri, f"row {job.row}: vehicle {job.vehicle!r} with this recording is in row "
                f"{first} too; remove one"
            )  # fmt: skip
