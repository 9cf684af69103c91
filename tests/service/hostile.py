"""Uploads that want to harm: bombs, paths, lies about sizes."""

import io
import json
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from tests.conftest import SAMPLE


@dataclass(frozen=True)
class Hostile:
    """An upload to the route ``kind``, with files, fields and names of files that want to harm."""

    name: str
    kind: str
    files: Mapping[str, bytes] = field(default_factory=dict)
    fields: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    is_harmless: bool = False  # the job does what was asked for


def hostile_uploads() -> list[Hostile]:
    """All of them; other broken files are in the tests of their readers."""
    return [*_names(), *_archives()]


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
