from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import FileError
from calibgraph.fleet.manifest import load_manifest

HEAD = "vehicle,recording,rig,settings,mileage_km\n"


def write(folder: Path, text: str, name: str = "fleet.csv") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_csv_and_parquet_give_the_same_jobs(tmp_path: Path) -> None:
    csv = write(tmp_path, HEAD + '001,a;b,rig.yaml,"{seed: 3, search_deg: 0}",12.5\n')
    cells = {"vehicle": ["001"], "recording": ["a;b"], "rig": ["rig.yaml"],
             "settings": ["{seed: 3, search_deg: 0}"], "mileage_km": [12.5]}  # fmt: skip
    parquet.write_table(pa.table(cells), tmp_path / "fleet.parquet")
    found = [load_manifest(uri) for uri in (csv, str(tmp_path / "fleet.parquet"))]
    assert found[0][0] == found[1][0]
    (job,) = found[0][0]
    assert job.vehicle == "001"
    assert job.recordings == (f"{tmp_path}/a", f"{tmp_path}/b")
    assert (job.settings.config.seed, job.settings.search_deg) == (3, 0.0)
    assert all(others.to_pylist() == [{"mileage_km": 12.5}] for _, others in found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vehicle,rig\na,b\n", "column 'recording' is missing, found vehicle, rig"),
        ("vehicle,recording,status\na,b,c\n", "column 'status' is one of the results' own"),
        (HEAD + "a\0b,c,,,1\n", r"row 0: vehicle 'a\x00b': has control characters; rename it"),
        (HEAD, "holds no rows"),
        (HEAD + ",b,,,1\n", "row 0: vehicle None: expected a name"),
        (HEAD + "a,,,,1\n", "row 0: recording None: expected a path or URI"),
        (HEAD + "a,b;,,,1\n", "row 0: recording 'b;': expected"),
        (HEAD + "a,b.parquet,,,1\n", "row 0: vehicle 'a': a table of correspondences needs"),
        (HEAD + "a,b.csv;c.csv,r,,1\n", "row 0: vehicle 'a': several tables"),
        (HEAD + "a,b,,,1\na,b,,,2\n", "row 1: vehicle 'a' with this recording is in row 0 too"),
        (HEAD + "a,b,,{gate: 3},1\n", "row 0: settings: unknown key 'gate'"),
        (HEAD + "a,b,,{search_deg: -1},1\n", "row 0: settings: search_deg:"),
        (HEAD + "a,b,,none.yaml,1\n", "row 0: settings: holds 'none.yaml', expected a mapping"),
        (HEAD + "a,b\n", "cannot be read as csv"),
        ("vehicle,recording,model,model\na,b,c,d\n", "column 'model' is there 2 times"),
        ("vehicle,vehicle,recording\na,a,b\n", "column 'vehicle' is there 2 times"),
        ("", "cannot be read as csv"),
    ],
)
def test_a_wrong_manifest_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        load_manifest(write(tmp_path, text))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_files_are_one_line(tmp_path: Path) -> None:
    for name, content, message in (
        ("a.parquet", b"", "cannot be read as parquet"),
        ("b.parquet", b"PAR1", "cannot be read as parquet"),
        ("c.csv", b"vehicle,\xe4", "cannot be read as csv"),
        ("y.yaml", b"a: 1", "must end in .parquet or .csv"),
        ("none.csv", None, "no such file"),
        ("nonsense://fleet.csv", None, "cannot be opened"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(FileError, match=message) as caught:
            load_manifest(name if "://" in name else str(tmp_path / name))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", ["recording", "rig", "settings"])
def test_the_input_hash_changes_with_every_input(tmp_path: Path, change: str) -> None:
    cloud = tmp_path / "drive" / "lidar" / "0.npy"
    cloud.parent.mkdir(parents=True)
    cloud.write_bytes(b"cloud")
    (tmp_path / "rig.yaml").write_text("a")
    uri = write(tmp_path, HEAD + "a,drive,rig.yaml,,1\n")
    before = load_manifest(uri)[0][0].input_hash()
    assert load_manifest(uri)[0][0].input_hash() == before
    if change == "recording":
        cloud.write_bytes(b"others")
    elif change == "rig":
        (tmp_path / "rig.yaml").write_text("b")
    else:
        write(tmp_path, HEAD + "a,drive,rig.yaml,{seed: 1},1\n")
    assert load_manifest(uri)[0][0].input_hash() != before
