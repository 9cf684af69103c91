"""What a command may write: never over what it reads, nor over what the program did not write.

Each kind of file holds a mark; a file without it is its user's.
"""

import os
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from calibgraph.errors import FileError

_PNG_HEADER_BYTES = 33  # signature and IHDR
_PARQUET_END_BYTES = 8  # length of the footer and magic
_SEARCHED_BYTES = 2**20  # at the beginning and at the end
PAGE_MARK = b'<meta name="generator" content="calibgraph">'
AUDIT_PAGE_MARK = b'<meta name="generator" content="calibgraph check">'
DOT_MARK = "// calibgraph graph"
VIEW_MARK = "calibgraph-view"
WEIGHTS_MARK = "calibgraph-cmrnext/1"


@dataclass(frozen=True)
class Output:
    """A file that a command writes.

    Attributes:
        by: the commands that write such files, in a message.
        marks: the program's files hold one of them; without marks no file is replaced.
        suffixes: the endings that its name may have, if not any.
        marked: another file that holds the mark, for formats without a place for one.
    """

    path: Path
    by: str
    marks: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
    marked: Path | None = None

    @property
    def is_ours(self) -> bool:
        """Whether a file that exists was written by the program, so that it may be replaced."""
        return any(is_marked(self.marked or self.path, mark) for mark in self.marks)


def is_marked(path: Path, mark: bytes) -> bool:
    """Whether a file holds a mark near its beginning or its end."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if mark in file.read(_SEARCHED_BYTES):
            return True
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - max(_SEARCHED_BYTES, _parquet_footer_bytes(file))))
        return mark in file.read()


def _parquet_footer_bytes(file: BinaryIO) -> int:
    """The length of the footer, which holds the metadata, and its frame; 0 for other files."""
    file.seek(max(0, file.seek(0, os.SEEK_END) - _PARQUET_END_BYTES))
    length, magic = file.read(4), file.read(4)
    return int.from_bytes(length, "little") + _PARQUET_END_BYTES if magic == b"PAR1" else 0


def require_writable(outputs: Iterable[Output], read: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that files can be written without the loss of others.

    Raises:
        FileError: if one of the outputs cannot be written, is read, or exists and is not ours.
    """
    from calibgraph.files import require_place_for_file  # the help of commands needs none of it

    read = [path for path in read if path.exists()]
    for output in outputs:
        path = output.path
        require_place_for_file(path, *output.suffixes)
        if path.exists() and any(path.samefile(other) for other in read):
            raise FileError(
                path, "is read by this command, which would replace it; choose another --out"
            )
        if os.path.lexists(path) and not output.is_ours:
            raise FileError(
                path,
                f"was not written by calibgraph {output.by}, and would be replaced; move it, or "
                "choose another --out",
            )


def yaml_mark(command: str) -> str:
    """The first line of a YAML file that a command writes."""
    return f"# Written by calibgraph {command}"


def marked_yaml(path: Path, command: str) -> Output:
    """A YAML file with the mark of a command."""
    return Output(path, command, (yaml_mark(command).encode() + b"\n",), (".yaml", ".yml"))


def png_mark(command: str) -> bytes:
    """The text of a PNG picture that names the command which wrote it."""
    return b"tEXtSoftware\0calibgraph " + command.encode()


def with_png_mark(picture: bytes, command: str) -> bytes:
    """A PNG picture with the mark of a command in a chunk behind its header."""
    text = png_mark(command)
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    return picture[:_PNG_HEADER_BYTES] + chunk + picture[_PNG_HEADER_BYTES:]
