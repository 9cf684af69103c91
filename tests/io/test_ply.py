"""Vertices among other elements, in every encoding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud
from tests.io.written import CLOUD, ply

FACES = b"element face 2\nproperty list uchar int vertex_indices\nproperty float area\n"
BINARY_FACES = b"\x03" + bytes(16) + b"\x00" + bytes(4)
TEXT_FACES = b"3 0 1 2 0.5\n0 0.5\n"
CAMERA = b"element camera 1\nproperty double f\nproperty uchar k\nelement empty 7\n"


@pytest.mark.parametrize(
    "data",
    [
        ply(),
        ply("binary_big_endian"),
        ply("ascii"),
        ply("ascii").replace(b"\n", b"\r\n"),
        ply().replace(b"comment by hand", b"obj_info end_header here\r"),
        ply().replace(b"float", b"float32"),
        ply(names=("X", "y", "z", "scalar_Scalar Intensity".replace("Scalar ", ""))),
        ply(before=CAMERA, body=bytes(9) + CLOUD.tobytes()),
        ply(before=FACES, body=BINARY_FACES + CLOUD.tobytes()),
        ply(after=FACES, body=CLOUD.tobytes() + BINARY_FACES),
        ply("ascii", before=FACES, body=TEXT_FACES + ply("ascii").split(b"end_header\n")[1]),
        ply("ascii", after=FACES, body=ply("ascii").split(b"end_header\n")[1] + TEXT_FACES),
    ],
)
def test_vertices_are_read_to_the_last_bit(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(data)
    np.testing.assert_array_equal(load_cloud(tmp_path / "cloud.ply"), CLOUD)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (ply().replace(b"vertex 500", b"vertex 499"), "goes on after the 499 points"),
        (ply("ascii").replace(b"vertex 500", b"vertex 499"), "goes on after the 499 points"),
        (ply().replace(b"vertex 500", b"vertex 501"), "is truncated"),
        (ply("ascii").replace(b"vertex 500", b"vertex 501"), "is truncated: 500 of its 501"),
        (ply().replace(b"vertex 500", b"vertex " + b"9" * 18), "is truncated"),
        (ply().replace(b"vertex 500", b"vertex 0"), "holds no point"),
        (ply().replace(b"vertex 500", b"vertex -5"), "malformed PLY header"),
        (ply().replace(b"vertex", b"vertices"), "no plain list of vertices"),
        (ply(after=b"property list uchar int a\n"), "no plain list of vertices"),
        (ply(before=FACES.replace(b"uchar", b"char"), body=b"\xff" * 9000), "is truncated"),
        (ply(before=FACES.replace(b"uchar", b"float")), "malformed PLY header"),
        (ply(before=b"element face " + b"9" * 18 + FACES[14:]), "is truncated"),
        (ply().replace(b"float x", b"quad x"), "malformed PLY header, at 'property quad x'"),
        (ply().replace(b"ply\n", b"plx\n", 1), "no complete .ply header"),
        (
            ply("ascii").replace(b"end_header\n", b"end_header\n1 2 3\n"),
            "first point has 3 numbers",
        ),
        (ply("ascii")[:-20] + b" word\n", "no points where they should be"),
    ],
)
def test_malformed_files_are_one_line(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(data)
    with pytest.raises(FileError, match=message) as caught:
        load_cloud(tmp_path / "cloud.ply")
    assert "\n" not in str(caught.value)
