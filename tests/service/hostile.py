"""Uploads that want to harm: bombs, paths, lies about sizes, broken files."""

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.conftest import SAMPLE
from tests.io.test_frames import png

_CAMERA = "front_left"
_HUGE_PX = 60_000


@dataclass(frozen=True)
class Hostile:
    """An upload to the route ``kind``, with files, fields and names of files that want to harm."""

    name: str
    kind: str
    files: Mapping[str, bytes] = field(default_factory=dict)
    fields: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    is_harmless: bool = False  # the job does what was asked for


def hostile_uploads(rig: bytes) -> list[Hostile]:
    """All of them; YAML bombs, more broken tables and bags are in the tests of their readers."""
    return [*_parts(rig), *_names(), *_archives(), *_recordings()]


def _parts(rig: bytes) -> Iterator[Hostile]:
    names = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**7, np.int8)), ["l"])
    pq.write_table(pa.table({"camera": names}), bomb := io.BytesIO())
    contents = {
        "python object": ("rig", b"a: !!python/object/apply:os.system ['true']\n"),
        "control characters": ("rig", rig + b"\x00\x1b[2J"),
        "huge image": ("rig", rig.replace(b"width_px: 1240", b"width_px: 1e300")),
        "zip for a rig": ("rig", zipped({"rig.yaml": rig})),
        "empty rig": ("rig", b""),
        "bomb of one column": ("correspondences", bomb.getvalue()),
        "mark alone": ("correspondences", b"PAR1PAR1"),
        "CSV of one line": ("correspondences", b"a" * 20_000_000),
        "CSV of a million columns": ("correspondences", b"," * 1_000_000),
        "pickle": ("correspondences", pickle.dumps({"a": 1})),
    }
    for name, (part, content) in contents.items():
        yield Hostile(name, "solve", {part: content})
    settings = {
        "deep settings": "[" * 100_000,
        "NaN": '{"config": {"seed": NaN}}',
        "number of 6000 digits": '{"config": {"seed": ' + "9" * 6000 + "}}",
        "megabytes": " " * 1_100_000,
    }
    for name, text in settings.items():
        yield Hostile(name, "solve", fields={"settings": text})


def _names() -> Iterator[Hostile]:
    for name in ("../../evil.yaml", "/etc/passwd", "C:\\x", "a\x00b", "x" * 3000, "; rm -rf *"):
        yield Hostile(f"name: {name[:20]!r}", "solve", names={"rig": name}, is_harmless=True)
    yield Hostile("field: ../rig", "solve", {"../rig": b"x"})
    yield Hostile("field: rig/../../x", "solve", fields={"rig/../../x": "x"})
    yield Hostile("URI: file:///etc/passwd", "check", fields={"recording": "file:///etc/passwd"})
    yield Hostile("URI: of a chain", "check", fields={"recording": "simplecache::file:///etc"})


def _archives() -> Iterator[Hostile]:
    good = _dataset()
    bomb = zipped({"lidar/000000.npy": bytes(300_000_000)})
    lying = bytearray(zipped({"lidar/000000.npy": bytes(1000)}))
    place = lying.rfind(b"PK\x01\x02")
    lying[place + 24 : place + 28] = struct.pack("<I", 5)
    encrypted = bytearray(zipped(good))
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        encrypted[encrypted.find(mark) + offset] |= 1
    contents = {
        "bomb": bomb,
        "bomb in a bomb": zipped({"lidar/a.npy": bomb}),
        "many files": zipped({f"lidar/{i}.npy": b"" for i in range(100_001)}),
        "long name": zipped({f"lidar/{'x' * 5000}.npy": b""}),
        "file for a folder": zipped({"lidar/a": b"", "rig.yaml": b"", "cameras/lidar/lidar": b""}),
        "truncated": zipped(good)[:-100],
        "encrypted": bytes(encrypted),
        "lie about a size": bytes(lying),
        "unknown method": zipped(good).replace(
            b"PK\x01\x02\x14\x03\x14\x00\x00\x00\x08\x00",
            b"PK\x01\x02\x14\x03\x14\x00\x00\x00\x63\x00",
        ),
        "empty": zipped({}),
    }
    for name, content in contents.items():
        yield Hostile(f"archive: {name}", "calibrate", {"recording": content})


def _recordings() -> Iterator[Hostile]:
    image = f"cameras/{_CAMERA}/000000.jpg"
    bomb = png(_HUGE_PX, _HUGE_PX, bytes(_HUGE_PX * 100))  # kilobytes for 3.6 gigapixels
    good = _dataset()
    without = {name: content for name, content in good.items() if name != image}
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000, 4), }"
    huge = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.ljust(117) + b"\n" + bytes(64)
    contents = {
        "image bomb": zipped({**without, f"cameras/{_CAMERA}/000000.png": bomb}),
        "SVG for an image": zipped({**good, image: b"<svg onload='alert(1)'/>"}),
        "cloud of 288 GB": zipped({**good, "lidar/000000.npy": huge}),
        "ROS 1 with a huge record": b"#ROSBAG V2.0\n" + struct.pack("<I", 2**31 - 1) + bytes(50),
        "MCAP with a huge record": b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 2**62) + bytes(50),
        "SQLite of garbage": b"SQLite format 3\0" + bytes(range(256)) * 20,
        "an executable": b"\x7fELF" + bytes(100),
        "nothing": b"",
    }
    for name, content in contents.items():
        yield Hostile(f"recording: {name}", "calibrate", {"recording": content})


def _dataset() -> dict[str, bytes]:
    """The sample with one frame."""
    cameras = [folder.name for folder in (SAMPLE / "cameras").iterdir()]
    names = ["rig.yaml", "lidar/000000.npy", *(f"cameras/{c}/000000.jpg" for c in cameras)]
    return {name: (SAMPLE / name).read_bytes() for name in names}


def zipped(files: Mapping[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def as_form(upload: Hostile, rig: bytes, table: bytes) -> tuple[list, dict[str, str]]:  # type: ignore[type-arg]
    """The files and the fields of a form, the good parts with the hostile ones."""
    good = {"solve": {"rig": rig, "correspondences": table}, "check": {"rig": rig}}
    files = {**good.get(upload.kind, {}), **upload.files}
    parts = [(name, (upload.names.get(name, name), content)) for name, content in files.items()]
    settings = {"settings": json.dumps({"report": False})} if upload.kind == "solve" else {}
    return parts, {**settings, **upload.fields}
