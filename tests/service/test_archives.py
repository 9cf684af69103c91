"""Archives of datasets, as people and their file managers make them."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph.errors import FileError
from calibgraph.io.dataset import load_dataset
from calibgraph.service.archives import open_upload
from tests.conftest import SAMPLE
from tests.service.hostile import zipped

JUNK = {"__MACOSX/sample/._rig.yaml": b"x", "__MACOSX/._sample": b"x", ".DS_Store": b"x"}


def files_of_the_sample(top: str = "") -> dict[str, bytes]:
    found = (path for path in sorted(SAMPLE.rglob("*")) if path.is_file())
    return {f"{top}{path.relative_to(SAMPLE).as_posix()}": path.read_bytes() for path in found}


def unpacked(folder: Path, files: dict[str, bytes]) -> Path:
    upload = folder / "upload"
    upload.write_bytes(zipped(files))
    return open_upload(upload, folder / "recording", 10**9)


@pytest.mark.parametrize("top", ["", "sample/", "data/sample/", "My drive (1)/"])
@pytest.mark.parametrize("with_junk", [False, True])
def test_a_zip_of_a_dataset_is_one_in_whichever_folder_it_is(
    tmp_path: Path, top: str, with_junk: bool
) -> None:
    junk = JUNK | {f"{top}lidar/.DS_Store": b"x", f"{top}lidar/._000000.npy": b"x"}
    folder = unpacked(tmp_path, files_of_the_sample(top) | (junk if with_junk else {}))
    assert {path.name for path in folder.iterdir()} == {"rig.yaml", "cameras", "lidar"}
    assert len(load_dataset(folder).frames) == len(load_dataset(SAMPLE).frames)


def test_a_folder_named_as_a_part_of_a_dataset_is_no_trap(tmp_path: Path) -> None:
    folder = unpacked(tmp_path, files_of_the_sample("lidar/"))
    assert {path.name for path in folder.iterdir()} == {"rig.yaml", "cameras", "lidar"}


def test_a_bag_in_a_folder_is_found(tmp_path: Path) -> None:
    folder = unpacked(tmp_path, {"drive/metadata.yaml": b"a: 1", "drive/drive_0.mcap": b"x"})
    assert {path.name for path in folder.iterdir()} == {"metadata.yaml", "drive_0.mcap"}


def test_what_is_no_part_of_a_dataset_is_left_out_and_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = unpacked(tmp_path, files_of_the_sample("s/") | {"s/README.md": b"x"})
    assert not (folder / "README.md").exists()
    assert "README.md" in capsys.readouterr().out


@pytest.mark.parametrize(
    "name",
    [
        "s/lidar/scan 1.npy",
        "s/../lidar/1.npy",
        "/s/lidar/1.npy",
        "s\\lidar\\1.npy",
        "s//lidar/1.npy",
    ],
)
def test_data_whose_name_is_not_understood_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileError, match="expected rig.yaml"):
        unpacked(tmp_path, files_of_the_sample("s/") | {name: b"x"})
    assert not (tmp_path / "recording").exists()


def test_a_zip_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="expected rig.yaml"):
        unpacked(tmp_path, {"notes/a.txt": b"x"})
