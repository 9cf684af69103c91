"""Reading and writing files safely: atomic writes, hashes, content to checked models."""

import errno
import hashlib
import io
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from calibgraph.errors import FileError
from calibgraph.yaml_text import describe_value, parse_yaml, yaml_text

Model = TypeVar("Model", bound=BaseModel)

MAX_YAML_BYTES = 8 * 2**20


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file of another folder with ``write``, then move it to ``path`` in one step.

    A crash leaves the old file or the new one, never half of one.

    Raises:
        FileError: if there is no place for it.
        OSError: if it cannot be written; with the path.
    """
    require_new_file(path, force=True)
    with written_together(path.parent, last=path.name) as new:
        try:
            write(new / path.name)
            sync_to_disk(new / path.name)
        except OSError as error:
            if error.filename and not str(error.filename).startswith(str(new)):
                raise  # of another file, which is read
            raise cannot_write(path, error) from error


def cannot_write(path: Path, error: Exception, number: int | None = None) -> OSError:
    """An error of the disk, with the file that it is about."""
    number = number or getattr(error, "errno", None) or errno.EIO
    reason = getattr(error, "strerror", None) or " ".join(str(error).split())
    refused = number in (errno.EPERM, errno.EACCES, errno.EROFS)
    remedy = "choose another folder" if refused else "free or mend the disk and start again"
    return OSError(number, f"cannot be written ({reason}); {remedy}", str(path))


def require_new_file(path: Path, *suffixes: str, force: bool = False) -> None:
    """Check, before hours of work, that a file with one of the suffixes can be written.

    Raises:
        FileError: if it is a folder, if a folder above it is a file or not writable, if it ends in
            none of the suffixes, or if it is there, without force or named as a result's main file.
    """
    if suffixes and path.suffix not in suffixes:
        raise FileError(path, f"the name of what is written must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise FileError(path, "is a folder, expected the name of a file to write")
    require_place_for_folder(path.parent)
    if path.name == INDEX_FILES[0] and path.exists():
        raise FileError(path, "has the name of a result's main file; choose another name")
    if os.path.lexists(path) and not force:
        raise FileError(path, "is there already; choose another name, or replace it with --force")


def require_place_for_folder(folder: Path) -> None:
    """Check, before hours of work, that a folder exists or can be created."""
    for part in (folder, *folder.parents):
        if part.exists() and not part.is_dir():
            raise FileError(part, "is a file, expected a folder to write into; choose another")
    existing = next(part for part in (folder, *folder.parents) if part.exists())
    if not os.access(existing, os.W_OK):
        raise FileError(existing, "may not be written to; choose another folder")


_PREFIX = ".writing-"
INDEX_FILES = (
    "calibration.yaml", "doctor.json", "fleet_model.json", "session.json", "state/state.sqlite"
)  # fmt: skip
"""A folder that holds one of these is a command's own, and may be written again."""


def require_own_folder(folder: Path, read: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that a command may write its files into a folder.

    Raises:
        FileError: if there is no place for it, if it holds files and none of ``INDEX_FILES``, or if
            it is read itself.
    """
    require_place_for_folder(folder)
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    if all(name.startswith(_PREFIX) for name in names):  # of writers that were killed
        return
    if not any((folder / name).is_file() for name in INDEX_FILES):
        raise FileError(
            folder,
            f"holds files, but no {INDEX_FILES[0]} or other index file of calibgraph; choose "
            "another folder, or empty this one",
        )
    if any(path.is_dir() and path.samefile(folder) for path in read):
        raise FileError(
            folder, "is read by this command, which would write into it; choose another --out"
        )


@contextmanager
def written_together(folder: Path, *, last: str) -> Iterator[Path]:
    """In the body, a folder for files that are moved into ``folder`` at its end.

    After an error in it, as of a full disk, none of them is there, and older ones are as they were.
    The file named ``last`` is moved last: if the process is killed, it is not there before others.

    Raises:
        FileError: if there is no place for them.
        OSError: if they cannot be written; with the path where the file should be.
    """
    require_place_for_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        made = tempfile.TemporaryDirectory(dir=folder, prefix=_PREFIX)
    except OSError as error:
        raise cannot_write(folder, error) from error
    with made as name:
        try:
            yield Path(name)
        except OSError as error:  # of a file where it will be, not where it is written
            error.filename = error.filename and str(error.filename).replace(name, str(folder), 1)
            raise
        for new in sorted(Path(name).iterdir(), key=lambda path: path.name == last):
            try:
                new.replace(folder / new.name)
            except OSError as error:
                raise cannot_write(folder / new.name, error) from error
        sync_to_disk(folder)


def is_utf8(name: str) -> bool:
    """Whether a path is text: Python reads other bytes as surrogates, which no result can hold."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def sync_to_disk(path: Path) -> None:
    """Make a file durable, or the renames in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_atomically(path, lambda temporary: temporary.write_text(text, "utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a binary file atomically."""
    write_atomically(path, lambda temporary: temporary.write_bytes(data))


def sha256(path: Path) -> str:
    """Hex digest of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def require_file(path: Path) -> Path:
    """Return ``path`` if it is a file.

    Raises:
        FileError: if it is missing or a folder, or no file can have its name.
    """
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
    except OSError as error:  # a name that is too long, or a folder above that may not be read
        raise FileError(path, f"cannot be read ({error.strerror}); check the path") from error
    if is_folder:
        raise FileError(path, "is a folder, expected a file")
    if not is_file and os.path.lexists(path):
        raise FileError(path, "is no file that can be read: a pipe, a device or a link to nothing")
    if not is_file:
        raise FileError(path, "no such file; check the path")
    return path


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping.

    Raises:
        FileError: if the file is missing, too large, not YAML, or not a mapping.
    """
    return parse_yaml(_read_small(path, "YAML"), path)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        FileError: if the file is missing, too large, not JSON, or no object.
    """
    try:
        content = json.loads(_read_small(path, "JSON"))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is not valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise FileError(path, f"holds {describe_value(content)}, expected an object {{...}}")
    return content


def _read_small(path: Path, kind: str) -> str:
    if (size := require_file(path).stat().st_size) > MAX_YAML_BYTES:
        raise FileError(path, f"{size} bytes is too large for a {kind} file")
    return read_text(path)


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, with a byte order mark or without."""
    return decode_text(require_file(path).read_bytes(), path)


def decode_text(data: bytes, path: Path | str) -> str:
    """The text of a file.

    Raises:
        FileError: if it is of another encoding, or no text.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    try:
        return io.StringIO(data.decode(), newline=None).read()
    except UnicodeDecodeError as error:
        if b"\0" in data:
            raise FileError(path, f"is not a text file in UTF-8 ({error.reason})") from error
        line = data.count(b"\n", 0, error.start) + 1
        raise FileError(
            path,
            f"is not UTF-8: line {line} holds the byte 0x{data[error.start]:02x}, a letter "
            "of Latin-1 or Windows-1252, say; save it as UTF-8",
        ) from error


def write_yaml(path: Path, content: dict[str, Any], *, first_line: str = "") -> None:
    """Write a mapping as YAML, atomically; keys keep their order, number lists stay on one line."""
    text = yaml_text(content)
    write_text(path, f"{first_line}\n{text}" if first_line else text)


class StrictNumbers(BaseModel):
    """A frozen model of known keys, whose numbers are no truth values: ``true`` is not 1 px."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_truth_values(cls, value: Any, info: ValidationInfo) -> Any:
        wanted = cls.model_fields[info.field_name or ""].annotation
        if bool not in (wanted, *get_args(wanted)) and holds_truth_value(value):
            raise ValueError(f"expected no truth value, found {describe_value(value)}")
        return value


def holds_truth_value(value: object) -> bool:
    """Whether it is True or False, or a list that holds one."""
    if isinstance(value, (list, tuple)):
        return any(map(holds_truth_value, value))
    return isinstance(value, (bool, np.bool_))


def checked_model(model: type[Model], content: Any, path: Path | str) -> Model:
    """Build a pydantic model from file content.

    Raises:
        FileError: with the first problem: where, what was found, what is expected.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError(path, describe(error)) from error


_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+(e[-+]?[0-9]+)?")


def describe(error: ValidationError) -> str:
    """First problem of a pydantic error, in one line; a misspelt key before a missing one."""
    problems = error.errors()
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        inverse = re.sub("T_([^_]+)_([^_]+)", r"T_\2_\1", str(first["loc"][-1]))
        missing = [each["loc"] for each in problems if each["type"] == "missing"]
        if (*first["loc"][:-1], inverse) in missing:
            return f"unknown key {where!r}; give its inverse, {inverse}"
        return f"unknown key {where!r}; remove it or correct its spelling"
    if first["type"] == "missing":
        return f"key {where!r} is missing; add it"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("model_type", "dict_type"):  # its message names a class or a dictionary
        message = "expected keys with values, as in {key: value}"
    found = "" if first["type"] == "value_error" else f", found {describe_value(first['input'])}"
    if isinstance(first["input"], str) and _DECIMAL_COMMA.fullmatch(first["input"].strip()):
        found += f": write {first['input'].strip().replace(',', '.')}, with a point"
    return f"{where}: {message}{found}" if where else f"{message}{found}"
