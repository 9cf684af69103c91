"""Uploads that want to harm: bombs, paths, lies about sizes, broken files."""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.conftest import SAMPLE

_CAMERA = "front_left"
_HUGE_PX = 60_000


@dataclass(frozen=True)
class Hostile:
    """An upload: its parts in place of those of a good one.

    Attributes:
        name: of the attack.
        kind: path of the route.
        files: contents by the name of the field.
        fields: texts by the name of the field.
        names: of files, as the sender gives them.
        is_harmless: whether the job does what was asked for.
    """

    name: str
    kind: str
    files: Mapping[str, bytes] = field(default_factory=dict)
    fields: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    is_harmless: bool = False


def hostile_uploads(rig: bytes) -> list[Hostile]:
    """All of them."""
    return [*_rigs(rig), *_tables(), *_settings(), *_names(), *_archives(), *_recordings()]


def _rigs(rig: bytes) -> Iterator[Hostile]:
    aliases = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    aliases += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    many = "".join(f" c{i}: {{}}\n" for i in range(50_000))
    contents = {
        "alias bomb": "\n".join(aliases).encode(),
        "merge bomb": b"a: &a {x: 1}\nb: {<<: [" + b"*a, " * 60_000 + b"*a]}\n",
        "deep lists": b"a: " + b"[" * 40_000,
        "deep maps": b"{a: " * 20_000,
        "python object": b"a: !!python/object/apply:os.system ['true']\n",
        "huge number": b"a: " + b"9" * 50_000,
        "huge hexadecimal": b"format: 0x" + b"f" * 50_000,
        "binary": bytes(range(256)) * 10,
        "empty": b"",
        "zip": zipped({"rig.yaml": rig}),
        "many cameras": b"format: calibgraph-rig/1\nlidar: lidar\ncameras:\n" + many.encode(),
        "pose of NaN": rig.replace(b"T_camera_lidar:\n", b"T_camera_lidar: [[.nan]]\n #", 1),
        "huge image": rig.replace(b"width_px: 1240", b"width_px: 1e300"),
        "control characters": rig + b"\x00\x1b[2J",
        "another encoding": rig.decode().encode("utf-32"),
        "unknown key": rig + b"evil: 1\n",
    }
    for name, content in contents.items():
        yield Hostile(f"rig: {name}", "solve", {"rig": content})


def _tables() -> Iterator[Hostile]:
    good = {
        "camera": pa.array(["left"] * 10), "frame": pa.array([0] * 10),
        **{name: pa.array([1.0] * 10) for name in ("u_px", "v_px", "x_m", "y_m", "z_m")},
    }  # fmt: skip
    table = _parquet(pa.table(good))
    bomb = pa.table(
        {"camera": pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**7, np.int8)), ["l"])}
    )
    contents = {
        "bomb of one column": _parquet(bomb),
        "footer beyond the file": table[:-8] + struct.pack("<I", 2**31 - 1) + b"PAR1",
        "truncated": table[: len(table) // 2],
        "footer of garbage": table[:-60] + bytes(52) + table[-8:],
        "mark alone": b"PAR1PAR1",
        "texts for numbers": _parquet(pa.table({**good, "u_px": pa.array(["x"] * 10)})),
        "infinities": _parquet(pa.table({**good, "x_m": pa.array([float("inf")] * 10)})),
        "nested columns": _parquet(pa.table({**good, "u_px": pa.array([[[1.0]]] * 10)})),
        "unknown camera": _parquet(pa.table({**good, "camera": pa.array(["../x"] * 10)})),
        "huge frame": _parquet(pa.table({**good, "frame": pa.array([2**63 - 1] * 10)})),
        "no columns": _parquet(pa.table({"x": pa.array([1])})),
        "CSV of one line": b"a" * 20_000_000,
        "CSV of quotes": b'camera,frame\n"' + b"x\n" * 100_000,
        "CSV of a million columns": b"," * 1_000_000,
        "CSV of zeros": bytes(1_000_000),
        "pickle": pickle.dumps({"a": 1}),
        "empty": b"",
    }
    for name, content in contents.items():
        yield Hostile(f"table: {name}", "solve", {"correspondences": content})


def _settings() -> Iterator[Hostile]:
    contents = {
        "deep": "[" * 100_000,
        "NaN": '{"config": {"seed": NaN}}',
        "a list": "[1]",
        "unknown": '{"evil": 1}',
        "huge number": '{"config": {"seed": ' + "9" * 6000 + "}}",
        "megabytes": " " * 1_100_000,
    }
    for name, content in contents.items():
        yield Hostile(f"settings: {name}", "solve", fields={"settings": content})


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
        "parent folder": zipped({"../evil.npy": b""}),
        "absolute": zipped({"/tmp/evil.npy": b""}),
        "backslash": zipped({"..\\evil.npy": b""}),
        "in the middle": zipped({"lidar/../../evil.npy": b""}),
        "hidden": zipped({"lidar/.bashrc": b""}),
        "long name": zipped({f"lidar/{'x' * 5000}.npy": b""}),
        "case": zipped({"lidar/a.npy": b"", "lidar/A.npy": b""}),
        "file for a folder": zipped({"lidar/a": b"", "rig.yaml": b"", "cameras/lidar/lidar": b""}),
        "link": _link(),
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
    png = f"cameras/{_CAMERA}/000000.png"
    good = _dataset()
    without = {name: content for name, content in good.items() if name != image}
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000, 4), }"
    huge = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.ljust(117) + b"\n" + bytes(64)
    objects = io.BytesIO()
    np.save(objects, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    changes = {
        "image bomb": {**without, png: _png_bomb()},
        "truncated image": {**good, image: good[image][:2000]},
        "image of garbage": {**good, image: b"\xff\xd8\xff" + bytes(5000)},
        "SVG for an image": {**good, image: b"<svg onload='alert(1)'/>"},
        "cloud of 288 GB": {**good, "lidar/000000.npy": huge},
        "cloud of objects": {**good, "lidar/000000.npy": objects.getvalue()},
        "cloud of garbage": {**good, "lidar/000000.npy": b"\x93NUMPY" + bytes(100)},
        "rig bomb": {**good, "rig.yaml": b"a: " + b"[" * 40_000},
    }
    for name, files in changes.items():
        yield Hostile(f"recording: {name}", "calibrate", {"recording": zipped(files)})
    bags = {
        "ROS 1 mark alone": b"#ROSBAG V2.0\n",
        "ROS 1 with a huge record": b"#ROSBAG V2.0\n" + struct.pack("<I", 2**31 - 1) + bytes(50),
        "MCAP mark alone": b"\x89MCAP0\r\n",
        "MCAP with a huge record": b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 2**62) + bytes(50),
        "SQLite of garbage": b"SQLite format 3\0" + bytes(range(256)) * 20,
        "an executable": b"\x7fELF" + bytes(100),
        "nothing": b"",
    }
    for name, content in bags.items():
        yield Hostile(f"bag: {name}", "calibrate", {"recording": content})


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


def _link() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        member = zipfile.ZipInfo("lidar/000000.npy")
        member.external_attr = 0o120777 << 16
        archive.writestr(member, "/etc/passwd")
    return out.getvalue()


def _parquet(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def _png_bomb() -> bytes:
    """Some kilobytes that stand for 3.6 gigapixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    size = struct.pack(">IIBBBBB", _HUGE_PX, _HUGE_PX, 8, 0, 0, 0, 0)
    lines = zlib.compress(bytes(_HUGE_PX * 100))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", lines) + chunk(b"IEND", b"")


def as_form(upload: Hostile, rig: bytes, table: bytes) -> tuple[list, dict[str, str]]:  # type: ignore[type-arg]
    """The files and the fields of a form, the good parts with the hostile ones."""
    good: dict[str, bytes] = {}
    if upload.kind == "solve":
        good = {"rig": rig, "correspondences": table}
    if upload.kind == "check":
        good = {"rig": rig}
    files = {**good, **upload.files}
    parts = [(name, (upload.names.get(name, name), content)) for name, content in files.items()]
    fields = dict(upload.fields)
    if upload.kind == "solve" and "settings" not in fields:
        fields["settings"] = json.dumps({"report": False})
    return parts, fields
