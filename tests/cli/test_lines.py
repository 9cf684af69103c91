"""What is wrong in a command line is said in one line, with exit code 2, and nothing is written."""

from pathlib import Path

import pytest

from calibgraph import load_dataset
from calibgraph.pick.server import Workspace
from tests.cli.conftest import error_line, save_problem
from tests.conftest import SAMPLE, Call
from tests.io.bags.writing import sample_bag
from tests.io.formats.calibration_files import CAMERA_INFO, KALIBR, URDF, write

DEGREES = URDF.replace('rpy="0 0 0"', 'rpy="0 0 90"')
LINES = """
calibrate | missing argument
calibrate {sample} --colour red | see calibgraph calibrate --help
calibrat {sample} | see calibgraph --help
evaluate | see calibgraph evaluate --help
calibrate {sample} --matcher magic | unknown matcher 'magic'; known are 'structure', 'cmrnext' and a
calibrate {sample} --frames 9: | frames '9:'
calibrate nothing | no such folder
calibrate {sample} --every-s 2 | are given without a bag
calibrate {sample} --search-deg 0 --search-m 1.5 | per axis, found 0 deg and 1.5 m
calibrate {sample} --search-deg few | '--search-deg': Input should be a valid number
calibrate {sample} --search-deg nan | should be greater than or equal to 0
calibrate {sample} --matcher t.csv --search-m 1 | --search-m is for --matcher structure only
calibrate {sample} --weights a.tar | --weights is for --matcher cmrnext only
calibrate {sample} --config cpu.yaml | device is for --matcher cmrnext only
calibrate {sample} --matcher cmrnext | needs weights
calibrate {sample} --matcher cmrnext --weights none.tar | no such file of weights
calibrate {sample} --config tpu.yaml | device: Input should be 'auto', 'cpu' or 'cuda'
calibrate bag --topic lidar | give NAME=/TOPIC
calibrate bag --topic lidar=/a --topic lidar=/b | given 2 times
calibrate bag --config stamps.yaml | stamps: Input should be 'header' or 'record'
solve nothing.yaml table.parquet | no such file
solve rig.yaml half.parquet | cannot be read as Parquet
solve bad.yaml table.parquet | unknown key
solve rig.yaml table.parquet --config lambda.yaml | unknown key 'lambda'
solve rig.yaml table.parquet --config negative.yaml | gate_px
solve rig.yaml table.parquet --config preset.yaml | preset: Input should be 'kitti', 'walkley'
solve rig.yaml table.parquet --terms all | terms: Input should be 'stage1'
match {sample} --out table.txt | must end in .parquet or .csv
evaluate nothing.yaml rig.yaml | no such file or folder; name a rig file
evaluate empty rig.yaml | name a rig file, a result
evaluate rig.yaml {sample}/reference.yaml | not in the reference
perturb {sample} --out n.yaml --translation-m inf | a length >= 0 m, found 20.0 deg and inf m
perturb {sample} --out n.yaml --rotation-deg nan | should be greater than or equal to 0
perturb {sample} --out {sample} | must end in .yaml
export {sample} --out never --format ros | format 'ros'
export {sample} --out never --format urdf --camera rear | camera 'rear'
export {sample} --out never --format autoware --lidar-pose 1,2 | --lidar-pose '1,2': give six
export {sample} --out never --format autoware --lidar-pose 0,0,0,0,0,90 | yaw are 0, 0, 90 rad
export {sample} --out never --format autoware --lidar-pose 0,0,nan,0,0,0 | not finite
export {sample} --out never --format urdf --lidar-pose 0,0,0,0,0,0 | autoware only
export {sample} --out never --format urdf --camera-frame camera | two are the same
export nothing --out never --format urdf | no such file
rig info.yaml --out n.yaml | describe its mounting with --mount front=WORDS
rig chain.yaml --size 9 | --size '9': give WIDTHxHEIGHT
rig chain.yaml --camera-frame a | --camera-frame 'a': give two names
rig chain.yaml --rename front=a | no camera 'front' to rename
rig chain.yaml --rename cam0=cam1 | two cameras one name
rig chain.yaml --out n.txt | must end in .yaml
rig chain.yaml --topic lidar=/a | --topic is for bags alone only
rig chain.yaml --lens calibration | --lens is for a folder of images and clouds
rig chain.yaml --mount cam0=front --mount cam0=left | --mount cam0=...: given 2 times
rig chain.yaml --mount rear=front | no camera 'rear'
rig info.yaml degrees.urdf | beyond 2 pi: are they in degrees?
rig nothing.yaml | no such file
rig bag --size 3x4 | --size is for files only
rig empty | no images; put those of each camera into
rig drive --mount rear=rear | --mount rear=...: no such camera
rig drive --lens wide | lens 'wide'; expected calibration
rig drive --lens rear=calibration | --lens rear=...: no such camera
rig drive --size 3x4 | --size is for files only
rig drive --json | --json is for bags alone or files only
check missing.yaml {sample} | missing.yaml
check {sample} missing | missing
check {sample} {sample} --tolerance-deg 0 | tolerance_deg must be positive
check {sample} {sample} --tolerance-cm nan | tolerance_cm must be positive
check {sample} {sample} --out check.txt | must end in .html
pick nothing --out session --no-show | no such folder
pick {sample} --out session --frames 99 --no-show | frames '99'
pick {sample} --out picked --no-show | session of other frames or cameras
pick {sample} --out bad.yaml --no-show | bad.yaml
fleet lacking.csv --out never | column 'recording' is missing
fleet fleet.csv --out never --dask nonsense://x | --dask nonsense://x: no sched
fleet fleet.csv --out never --dask tcp://x:1 --jobs 2 | --jobs is of this
report nothing | no such file
report {sample} | calibration.yaml: no such file
simulate nowhere --out never | unknown scenario 'nowhere'; known is street
simulate street --rig nosuch --out never | known are kitti, walkley, surround
simulate street --beams 3 --out never | 3 beams
simulate street --frames 0 --out never | 0 frames, 4.0 m apart: expected at least 1 frame
simulate street --rotation-deg 200 --out never | expected an angle within
"""
CONFIGS = {
    "cpu": "device: cpu", "tpu": "device: tpu",
    "stamps": "stamps: best", "lambda": "lambda: 3",
    "negative": "gate_px: -1", "preset": "preset: best",
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the lines name."""
    folder = save_problem(tmp_path_factory.mktemp("lines"))
    (folder / "half.parquet").write_bytes((folder / "table.parquet").read_bytes()[:1000])
    (folder / "bad.yaml").write_text("format: calibgraph-rig/1\ncameras: {a: {fov: 3}}\n")
    (folder / "empty").mkdir()
    (folder / "lacking.csv").write_text("vehicle\na\n")
    (folder / "fleet.csv").write_text("vehicle,recording\na,.\n")
    Workspace(load_dataset(SAMPLE, frames=":2"), folder / "picked").change([])
    for name, text in CONFIGS.items():
        (folder / f"{name}.yaml").write_text(f"{text}\n")
    write(folder, info__yaml=CAMERA_INFO, chain__yaml=KALIBR, degrees__urdf=DEGREES)
    (folder / "drive").mkdir()
    for name in ("lidar", "cameras"):
        (folder / "drive" / name).symlink_to(SAMPLE / name)
    made = sample_bag(folder / "made", "sqlite3")
    made.rename(folder / "bag")
    return folder


@pytest.mark.parametrize("line", [line for line in LINES.splitlines() if line])
def test_a_wrong_command_line_is_one_line(
    line: str, files: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    before = sorted(files.rglob("*"))
    command, _, said = (part.strip() for part in line.partition("|"))
    message = error_line(*call(*command.format(sample=SAMPLE).split()))
    assert said.lower() in message.lower()
    assert sorted(files.rglob("*")) == before
