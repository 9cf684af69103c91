"""Reading and writing files safely: atomic writes, hashes, YAML to checked models in one line."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError

from calibgraph.errors import FileError

Model = TypeVar("Model", bound=BaseModel)

MAX_YAML_BYTES = 8 * 2**20
MAX_YAML_VALUES = 1_000_000
MAX_YAML_DEPTH = 200  # of brackets: the parser in C ends the process at some ten thousand


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Write a temporary file beside ``path`` with ``write``, then rename it in one step.

    A crash leaves the old file or the new one, never half of one.
    """
    require_place_for_file(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".writing-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def require_place_for_file(path: Path, *suffixes: str) -> None:
    """Check, before hours of work, that a file can be written.

    Args:
        path: the file.
        suffixes: the endings that its name may have, if given: so that no other kind of file is
            overwritten by mistake.

    Raises:
        FileError: if it is a folder, if a folder above it is a file or not writable, or if it ends
            in none of the suffixes.
    """
    if suffixes and path.suffix not in suffixes:
        raise FileError(path, f"the name of what is written must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise FileError(path, "is a folder, expected the name of a file to write")
    require_place_for_folder(path.parent)


def require_place_for_folder(folder: Path) -> None:
    """Check, before hours of work, that a folder exists or can be created.

    Raises:
        FileError: if it or a parent is a file, or not writable.
    """
    for part in (folder, *folder.parents):
        if part.exists() and not part.is_dir():
            raise FileError(part, "is a file, expected a folder to write into; choose another")
    existing = next(part for part in (folder, *folder.parents) if part.exists())
    if not os.access(existing, os.W_OK):
        raise FileError(existing, "may not be written to; choose another folder")


def is_utf8(name: str) -> bool:
    """Whether a path is text: Python reads other bytes as surrogates, which no result can hold."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def sync_folder(folder: Path) -> None:
    """Make the renames in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_atomically(path, lambda temporary: _discard(temporary.write_text(text, "utf-8")))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a binary file atomically."""
    write_atomically(path, lambda temporary: _discard(temporary.write_bytes(data)))


def _discard(_: object) -> None:
    return None


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
    if not is_file:
        raise FileError(path, "no such file; check the path")
    return path


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping.

    Raises:
        FileError: if the file is missing, too large, not YAML, or not a mapping.
    """
    require_file(path)
    if path.stat().st_size > MAX_YAML_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes is too large for a YAML file")
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, path: Path | str) -> dict[str, Any]:
    """The mapping in the text of a YAML file.

    Raises:
        FileError: if it is not YAML, not a mapping, or too deep or large when written out.
    """
    if _bracket_depth(text) > MAX_YAML_DEPTH:
        raise FileError(path, _TOO_DEEP)
    try:
        content = yaml.load(text, Loader=_Loader)
        expanded = _expanded_size(content, {})
    except (yaml.YAMLError, ValueError) as error:
        why = str(error).replace('in "<unicode string>", ', "")
        raise FileError(path, f"is not valid YAML: {why}") from error
    except RecursionError:
        raise FileError(path, _TOO_DEEP) from None
    if not isinstance(content, dict):
        raise FileError(path, f"holds {_kind(content)}, expected a mapping of keys to values")
    if expanded > MAX_YAML_VALUES:
        raise FileError(
            path, f"its aliases stand for over {MAX_YAML_VALUES} values; write them out"
        )
    return content


_TOO_DEEP = "is nested too deeply; expected a mapping of keys to values"


def _bracket_depth(text: str) -> int:
    """Depth to which brackets are nested; those in quotes count too."""
    data = np.frombuffer(text.encode(), np.uint8)
    opened = np.isin(data, np.frombuffer(b"[{", np.uint8)).astype(np.int64)
    closed = np.isin(data, np.frombuffer(b"]}", np.uint8)).astype(np.int64)
    return int(np.cumsum(opened - closed).max(initial=0))


def read_text(path: Path) -> str:
    """Read a text file.

    Raises:
        FileError: if it is missing, or not UTF-8.
    """
    try:
        return require_file(path).read_text("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(path, f"is not a text file ({error.reason})") from error


def _expanded_size(value: Any, sizes: dict[int, int]) -> int:
    """Number of values when every alias is written out; each is visited once."""
    if not isinstance(value, (dict, list)):
        return 1
    if id(value) not in sizes:
        children = value.values() if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_expanded_size(child, sizes) for child in children)
    return sizes[id(value)]


def write_yaml(path: Path, content: dict[str, Any], *, first_line: str = "") -> None:
    """Write a mapping as YAML, atomically; keys keep their order, number lists stay on one line.

    Args:
        path: of the file.
        content: the mapping.
        first_line: a comment above it.
    """
    text = yaml_text(content)
    write_text(path, f"{first_line}\n{text}" if first_line else text)


def yaml_text(content: dict[str, Any]) -> str:
    """A mapping as YAML, as :func:`write_yaml` writes it."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=200, allow_unicode=True))


def checked_model(model: type[Model], content: Any, path: Path | str) -> Model:
    """Build a pydantic model from file content.

    Raises:
        FileError: with the first problem: where, what was found, what is expected.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError(path, describe(error)) from error


def describe(error: ValidationError) -> str:
    """First problem of a pydantic error, in one line; a misspelt key before a missing one."""
    first = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown key {where!r}; remove it or correct its spelling"
    if first["type"] == "missing":
        return f"key {where!r} is missing; add it"
    message = first["msg"].removeprefix("Value error, ")
    found = "" if first["type"] == "value_error" else f", found {_kind(first['input'])}"
    return f"{where}: {message}{found}" if where else f"{message}{found}"


def _kind(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of thousands of digits
        text = f"a {type(value).__name__} of too many digits"
    return text if len(text) <= 60 else f"{text[:57]}..."  # noqa: PLR2004 - a line's worth


_FastLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_FastLoader):  # type: ignore[misc, valid-type]
    """YAML that refuses a key given twice: PyYAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (str, int)) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(key if isinstance(key, (str, int)) else id(key_node))
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Copy the values of merge keys (``<<``) into a mapping, and count them all."""
        super().flatten_mapping(node)
        self._flattened = getattr(self, "_flattened", 0) + len(node.value)
        if self._flattened > MAX_YAML_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"merge keys (<<) stand for over {MAX_YAML_VALUES} values",
                problem_mark=node.start_mark,
            )


# OpenCV's matrices: mappings with the keys rows, cols, dt and data.
_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_yaml_map)


class _Dumper(yaml.SafeDumper):
    """YAML with numpy values, and sequences of plain numbers on one line."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _represent_sequence(dumper: yaml.SafeDumper, data: Any) -> yaml.Node:
    items = list(data)
    flow = all(isinstance(item, (int, float, str, np.number)) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(list, _represent_sequence)
_Dumper.add_representer(tuple, _represent_sequence)
_Dumper.add_representer(np.ndarray, lambda dumper, data: _represent_sequence(dumper, data.tolist()))
_Dumper.add_multi_representer(np.floating, lambda dumper, data: dumper.represent_float(float(data)))
_Dumper.add_multi_representer(
    np.signedinteger, lambda dumper, data: dumper.represent_int(int(data))
)
