"""Uploads, written to disk as they arrive; their limits hold while they do."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from fastapi import Request
from python_multipart import MultipartParser
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import parse_options_header
from starlette.concurrency import run_in_threadpool

from calibgraph.service.problems import Problem

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

MOST_TEXT_BYTES = 10**6
MOST_PARTS = 110
_MOST_HEADER_BYTES = 4096


@dataclass(frozen=True)
class Upload:
    """The parts of a form: its texts in order, the names of its files, the SHA-256 of all."""

    texts: tuple[tuple[str, str], ...]
    files: tuple[str, ...]
    digest: str


@dataclass
class _Part:
    name: str = ""
    is_file: bool = False
    header: bytearray = field(default_factory=bytearray)
    disposition: bytes = b""
    text: bytearray = field(default_factory=bytearray)
    file: BinaryIO | None = None
    target: str = ""


class FormReader:
    """Reads a form: files into a folder, the second of a name ``a`` as ``a_1``, if allowed."""

    def __init__(self, folder: Path, allowed: Mapping[str, int]) -> None:
        self._folder, self._allowed = folder, allowed
        self._part = _Part()
        self._texts: list[tuple[str, str]] = []
        self._files: list[str] = []
        self._counts: dict[str, int] = {}
        self._digest = hashlib.sha256()
        self._is_whole = False
        self._parts = 0

    async def read(self, request: Request, arrive: Callable[[int], None]) -> Upload:
        """Read the form in a body; ``arrive`` gets the size of each piece before it is written.

        Raises:
            Problem: if it is malformed, or has a file that is not allowed.
        """
        _, options = parse_options_header(request.headers.get("content-type", ""))
        boundary = options.get(b"boundary", b"")
        if not boundary or len(boundary) > 70:  # noqa: PLR2004 - RFC 2046
            raise Problem(400, "the Content-Type has no boundary, or one that is too long")
        try:
            parser = MultipartParser(boundary, self._callbacks())
            async for chunk in request.stream():
                arrive(len(chunk))
                if chunk:
                    await run_in_threadpool(parser.write, chunk)  # it writes to disk
            parser.finalize()
        except MultipartParseError as error:
            raise Problem(400, f"the form cannot be read ({error})") from error
        finally:
            self._close()
        if not self._is_whole:
            raise Problem(400, "the form breaks off; send it again")
        return Upload(tuple(self._texts), tuple(self._files), self._digest.hexdigest())

    def _callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._on_part_begin,
            "on_header_field": self._on_header_field,
            "on_header_value": self._on_header_value,
            "on_header_end": self._on_header_end,
            "on_headers_finished": self._on_headers_finished,
            "on_part_data": self._on_part_data,
            "on_part_end": self._on_part_end,
            "on_end": self._on_end,
        }

    def _on_part_begin(self) -> None:
        self._part = _Part()
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise Problem(413, f"the form has over {MOST_PARTS} parts")

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._add_header(data[start:end])

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        if b":" not in self._part.header:
            self._add_header(b":")
        self._add_header(data[start:end])

    def _add_header(self, data: bytes) -> None:
        self._part.header += data
        if len(self._part.header) > _MOST_HEADER_BYTES:
            raise Problem(400, "a part of the form has a header that is too long")

    def _on_header_end(self) -> None:
        name, _, value = bytes(self._part.header).partition(b":")
        if name.strip().lower() == b"content-disposition":
            self._part.disposition = value
        self._part.header.clear()

    def _on_headers_finished(self) -> None:
        part = self._part
        _, options = parse_options_header(part.disposition)
        part.name = options.get(b"name", b"").decode(errors="replace")
        part.is_file = bool(options.get(b"filename"))  # empty: a page's field without a file
        self._digest.update(f"\0{part.is_file} {part.name!r}\0".encode())
        if not part.is_file:
            return
        count = self._counts.get(part.name, 0)
        if count >= self._allowed.get(part.name, 0):
            known = ", ".join(self._allowed)
            raise Problem(
                422, f"a file for {part.name[:60]!r} is not expected here; expected: {known}"
            )
        self._counts[part.name] = count + 1
        part.target = f"{part.name}_{count}" if count else part.name
        part.file = (self._folder / part.target).open("xb")

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        chunk = data[start:end]
        self._digest.update(chunk)
        if self._part.file is not None:
            self._part.file.write(chunk)
            return
        self._part.text += chunk
        if len(self._part.text) > MOST_TEXT_BYTES:
            raise Problem(413, f"a field of the form has over {MOST_TEXT_BYTES} bytes")

    def _on_part_end(self) -> None:
        part = self._part
        if part.file is not None:
            self._close()
            self._files.append(part.target)
            return
        try:
            self._texts.append((part.name, part.text.decode()))
        except UnicodeDecodeError as error:
            raise Problem(422, f"the field {part.name[:60]!r} is not UTF-8") from error

    def _on_end(self) -> None:
        self._is_whole = True

    def _close(self) -> None:
        """Put the file of the part on disk."""
        file, self._part.file = self._part.file, None
        if file is not None:
            file.flush()
            os.fsync(file.fileno())
            file.close()
