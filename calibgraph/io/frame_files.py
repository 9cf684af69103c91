"""Files of frames by the numbers, stems and stamps in their names."""

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from shlex import quote

from calibgraph.errors import FileError
from calibgraph.files import is_utf8, read_text, require_file

_PCD = ".pcd"  # NAME.pcd.bin is a cloud of nuScenes
_UNPACK = {".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz", ".lz4": "unlz4", ".zst": "unzstd",
           ".zstd": "unzstd"}  # fmt: skip
_WAYS_OUT = {
    **dict.fromkeys(
        (".las", ".laz"), "is not read: write it as .ply (`pdal translate {0} {1}.ply`)"
    ),
    **dict.fromkeys(
        (".mp4", ".mkv", ".avi", ".mov"),
        "is not read: write its pictures into a folder, named as their clouds "
        "(`mkdir {1}; ffmpeg -i {0} {1}/%06d.png`)",
    ),
    ".drc": "is not read: write it as .ply (`draco_decoder -i {0} -o {1}.ply`)",
    **{
        suffix: f"is compressed: unpack it first with `{unpack} {{0}}`"
        for suffix, unpack in _UNPACK.items()
    },
    **dict.fromkeys(
        (".zip", ".7z", ".tar", ".tgz"), "is an archive: unpack it and name what is in it"
    ),
    ".active": "was not closed: mend it with `rosbag reindex {0}` and name it {1}",
}
"""Per suffix that is not read, the way out; {0} is the file, {1} its name without the suffix."""


def way_out(path: Path) -> str | None:
    """What to do with a file that is not read; None if nothing is known for its suffix."""
    line = _WAYS_OUT.get(path.suffix.lower())
    return None if line is None else line.format(quote(f"{path}"), quote(f"{path.with_suffix('')}"))


def by_number(name: str) -> list[str | int | Decimal]:
    """The key that sorts names by the numbers in them: 9 before 10, frame_9 before frame_10."""
    if re.fullmatch(r"[0-9]+\.[0-9]+", name):  # seconds
        return ["", Decimal(name), "", name]
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if place % 2 else part for place, part in enumerate(parts)] + [name]


_DIGITS = re.compile(
    r"(?<![0-9])(?P<s>[1-9][0-9]{9})[._](?P<part>[0-9]{1,9})(?![0-9])"
    r"|(?<![0-9])(?P<whole>[1-9](?:[0-9]{9}|[0-9]{12}|[0-9]{15}|[0-9]{17,18}))(?![0-9])"
)
_NS_BY_DIGITS = {10: 1_000_000_000, 13: 1_000_000, 16: 1_000, 18: 1, 19: 1}


def stamp_ns_in_name(name: str) -> int | None:
    """The time that a name states [ns]; None of other names.

    It is the number with as many digits as seconds, milliseconds, microseconds or nanoseconds since
    1970 have now, or seconds with a fraction or with nanoseconds (1403636579.76, 1403636579_76...).
    """
    found = [*_DIGITS.finditer(name)]
    if len(found) != 1:
        return None
    if whole := found[0]["whole"]:
        return int(whole) * _NS_BY_DIGITS[len(whole)]
    return int(found[0]["s"]) * _NS_BY_DIGITS[10] + int(found[0]["part"].ljust(9, "0"))


def stated_stamps(folder: Path, count: int) -> Sequence[int | None]:
    """The stamps [ns] of so many clouds in times.txt, a line each; None without that file.

    A line is a number of seconds, or a time as :func:`stamp_ns_in_name` reads it.
    """
    path = folder / "times.txt"
    if not path.is_file():
        return [None] * count
    lines = read_text(path).split()
    if len(lines) != count:
        raise FileError(path, f"has {len(lines)} stamps for {count} clouds; write one a line")
    return [_stated_ns(path, line) for line in lines]


def _stated_ns(path: Path, line: str) -> int:
    stamp_ns = stamp_ns_in_name(line) if line.isdecimal() else None
    try:
        return round(Decimal(line) * 10**9) if stamp_ns is None else stamp_ns
    except (ArithmeticError, ValueError):  # no number, or NaN
        raise FileError(path, f"{line[:50]!r} is no time in seconds") from None


def files_by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Files of a folder with one of the suffixes, by stem, in the order of their numbers."""
    kinds = ", ".join(suffixes)
    if not folder.is_dir():
        beside = ", ".join(sorted(path.name for path in folder.parent.glob("*/"))) or "none"
        raise FileError(
            folder, f"no such folder; put the files ({kinds}) there, found are the folders {beside}"
        )
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda path: by_number(path.stem)):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            stem = path.stem.removesuffix(_PCD) if path.suffix == ".bin" else path.stem
            if stem in files:
                raise FileError(path, f"and {files[stem].name} are the same frame; keep one")
            if not is_utf8(path.name):
                raise FileError(path, "its name is not UTF-8; rename it")
            files[stem] = require_file(path)
    if not files:
        for path in sorted(folder.iterdir()):
            if remedy := way_out(path):
                raise FileError(path, remedy)
        raise FileError(folder, f"holds no file of a known kind; write or convert to {kinds}")
    return files
