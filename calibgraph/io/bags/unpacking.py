"""Compressed parts of bags, which may not unpack to any size: a chunk of 66 kB could fill 2 GiB."""

import bz2
from pathlib import Path
from typing import IO, Any

from calibgraph.errors import FileError

Buffer = bytes | memoryview

_ALWAYS, _RATIO, _MOST = 2**26, 50, 2**30
"""Of one part: a black image of 20 MP is 60 MB and packs to nothing; other data of sensors shrink
to a fiftieth at most."""
_ALWAYS_WHOLE, _RATIO_WHOLE = 2**28, 1000


def unpack(path: Path, kind: str, data: Buffer) -> Buffer:
    """The content of a compressed chunk or message.

    Args:
        path: its bag.
        kind: bz2, lz4 or zstd; empty or ``none`` if it is not compressed.
        data: the chunk or message.

    Raises:
        FileError: if the kind is unknown, or the content larger than a recording's can be.
        Exception: what the library raises for damaged data.
    """
    if kind in ("", "none"):
        return data
    most = max(_ALWAYS, min(_RATIO * len(data), _MOST))
    if kind == "zstd":
        import zstandard

        stated = zstandard.frame_content_size(data)  # -1 if it is not
        content: bytes = (
            zstandard.decompress(data) if 0 <= stated <= most
            else _zstd_stream(data).read(most + 1)
        )  # fmt: skip
    elif kind == "lz4":
        import lz4.frame

        content = lz4.frame.LZ4FrameDecompressor().decompress(data, most + 1)
    elif kind == "bz2":
        content = bz2.BZ2Decompressor().decompress(data, most + 1)
    else:
        raise FileError(
            path,
            f"is compressed by {kind!r}; known are bz2, lz4 and zstd: write it again with "
            "`mcap compress` or `rosbag compress`",
        )
    if len(content) > most:
        raise FileError(
            path,
            f"{len(data)} bytes of it unpack to more than {most >> 20} MiB, which no recording "
            "does; record it again, in chunks of a few MiB",
        )
    return content


def require_plausible(path: Path, packed: int, content: int) -> None:
    """Check what a whole file unpacks to.

    Raises:
        FileError: if it is more than a recording's can be.
    """
    if content > max(_ALWAYS_WHOLE, _RATIO_WHOLE * packed):
        raise FileError(
            path,
            f"its {packed} bytes unpack to {content >> 20} MiB or more, which no recording does; "
            "record it again",
        )


def unpack_file(path: Path, out: Path) -> None:
    """Write the content of a file compressed by zstd.

    Raises:
        FileError: if it is more than a recording's can be.
    """
    packed = path.stat().st_size
    with path.open("rb") as file, out.open("wb") as written:
        stream = _zstd_stream(file)
        while block := stream.read(2**20):
            written.write(block)
            require_plausible(path, packed, written.tell())


def _zstd_stream(source: Buffer | IO[bytes]) -> Any:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(source)
