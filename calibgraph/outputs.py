"""What a command may write: never over what it reads, nor over what the program did not write.

Each format has a mark by which its files are recognised; a file without one is its user's.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import require_place_for_file

_PNG_HEADER_BYTES = 33  # signature and IHDR
_DATA_FOLDERS = ("cameras", "lidar", "velodyne", "image_2", "image_3")


def is_never_ours(path: Path) -> bool:
    """For files without a place for a mark: none that exists is replaced."""
    return False


@dataclass(frozen=True)
class Output:
    """A file that a command writes.

    Attributes:
        path: of the file.
        by: the commands that write such files, in a message.
        is_ours: whether a file that exists has the program's mark, so that it may be replaced.
        suffixes: the endings that its name may have, if not any.
    """

    path: Path
    by: str
    is_ours: Callable[[Path], bool] = is_never_ours
    suffixes: tuple[str, ...] = ()


def require_free(outputs: Iterable[Output], read: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that files can be written without the loss of others.

    Args:
        outputs: the files to write.
        read: the files that are read.

    Raises:
        FileError: if one of the outputs cannot be written, is read, or exists and is not ours.
    """
    read = [path for path in read if path.exists()]
    for output in outputs:
        path = output.path
        require_place_for_file(path, *output.suffixes)
        if path.exists() and any(path.samefile(other) for other in read):
            raise FileError(
                path, "is read by this command, which would replace it; choose another --out"
            )
        if os.path.lexists(path) and not output.is_ours(path):
            raise FileError(
                path,
                f"was not written by calibgraph {output.by}, and would be replaced; move it, or "
                "choose another --out",
            )


def require_apart(path: Path, datasets: Iterable[Path]) -> None:
    """Check that what is written does not lie among the images and clouds of a dataset.

    There it would be taken for one of them, and the dataset refused from then on.

    Args:
        path: of the file or folder that is written.
        datasets: folders, or whatever else is read.

    Raises:
        FileError: if it does.
    """
    written = path.resolve()
    for folder in datasets:
        for part in _DATA_FOLDERS:
            if written.is_relative_to(folder.resolve() / part):
                raise FileError(
                    path, f"is among the data of {folder}, and would be read as such; choose "
                    "another --out"
                )  # fmt: skip


def yaml_mark(command: str) -> str:
    """The first line of a YAML file that a command writes."""
    return f"# Written by calibgraph {command}"


def has_yaml_mark(command: str) -> Callable[[Path], bool]:
    """Whether a YAML file was written by a command, by its first line."""
    return starts_with(yaml_mark(command).encode() + b"\n")


def png_mark(command: str) -> bytes:
    """The chunk of a PNG picture that names the command which wrote it."""
    text = b"tEXtSoftware\0calibgraph " + command.encode()
    return struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))


def with_png_mark(picture: bytes, command: str) -> bytes:
    """A PNG picture with the mark of a command behind its header."""
    return picture[:_PNG_HEADER_BYTES] + png_mark(command) + picture[_PNG_HEADER_BYTES:]


def has_png_mark(command: str) -> Callable[[Path], bool]:
    """Whether a PNG picture was written by a command."""
    return starts_with(png_mark(command), _PNG_HEADER_BYTES)


def starts_with(mark: bytes, behind: int = 0) -> Callable[[Path], bool]:
    """Whether a file starts with these bytes, behind so many others."""

    def is_marked(path: Path) -> bool:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(behind + len(mark))[behind:] == mark

    return is_marked
