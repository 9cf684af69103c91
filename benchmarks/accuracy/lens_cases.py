"""Recordings with lenses and clocks that are wrong, and ``--estimate``.

    python -m benchmarks.accuracy.lens_cases [--sets spoilt late] [--data 05,06] [--jobs 2]
    python -m benchmarks.accuracy.lens_cases --sets rendered --rigs 0:64 --scenes out/mixtures

``spoilt``: KITTI's lenses are wrong by what the docs of the verdict list, fixed and estimated, and
the distortion is estimated where nothing was spoilt. ``late``: each cloud with the image of the
next frame, which is 100 ms late. ``rendered``: drives of a camera like KITTI's whose lens and clock
are both wrong, by the number of the rig, in town at 2 to 15 m/s or on a road at an even speed;
calibrated with the right values, with the wrong ones, and with the wrong ones estimated.
All start 1 degree and 10 cm off. Cases are kept in ``--out``, a line each; a stopped run continues.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import Folders
from benchmarks.accuracy.verdicts import STATUSES, class_of
from benchmarks.tables import ROOT, Table
from calibgraph import Calibration, Config, Dataset, Rig, calibrate, load_dataset, perturb
from calibgraph.model.rig import Camera
from factors.columns import COEFFICIENT_NUMBERS
from tests.draws.lenses import put_lens_error, with_fields
from tools.scenes.rolling_drives import WRONG, draw_wrong, load_drive, truth_of

KITTI = ("05", "06", "07", "08", "06+07+08")
SPOILT = (
    ("focal", 0.03), ("focal", 0.05), ("centre", 20.0), ("distortion", 0.05)
)  # fmt: skip
DRIVES = ("00", "05", "06", "07", "08", "kitti_raw_0005")
INTERVAL_S, START_DEG, START_M, SEED = 0.1, 1.0, 0.1, 1
FIXED = "fixed"
SETS = ("spoilt", "late", "rendered")


def cases(rigs: Sequence[int]) -> Iterator[Key]:
    """All cases, by their kind: what is wrong, and what is estimated."""
    for name in KITTI:
        for part, error in SPOILT:
            for how in (FIXED, part):
                yield Key("spoilt", f"{part} {error:g} {how}", name, SEED)
    for name in ("07", "08"):
        yield Key("spoilt", "distortion 0 distortion", name, SEED)
    for name in DRIVES:
        for later in (0, 1):
            for how in (FIXED, "offset"):
                yield Key("late", f"{later} {how}", name, SEED)
    for seed in rigs:
        for kind in ("right", "wrong", "estimated"):
            yield Key("rendered", kind, "+".join(WRONG[seed % len(WRONG)]), seed)


def run_case(case: Key, folders: Folders, scenes: Path) -> Record:
    """Calibrate one case, and compare."""
    estimate = case.kind.split()[-1]
    data, truth, rig = _load(case, folders, scenes)
    if case.level == "rendered":
        estimate = case.data.replace("+", ",") if case.kind == "estimated" else FIXED
    guess = perturb(rig, rotation_deg=START_DEG, translation_m=START_M, seed=case.seed)
    config = Config() if estimate == FIXED else Config(estimate=estimate)
    return _to_record(calibrate(data, guess, config=config), truth)


def _load(case: Key, folders: Folders, scenes: Path) -> tuple[Dataset, Rig, Rig]:
    """The data, the right rig, and the one that is stated."""
    if case.level == "rendered":
        truth = truth_of(case.seed)
        data = load_drive(scenes, case.seed)
        return data, truth, truth if case.kind == "right" else _wrong_rig(truth, case.seed)
    data, truth = folders.load(case.data)
    if case.level == "spoilt":
        part, error, _ = case.kind.split()
        spoilt = put_lens_error(truth, part, float(error)) if float(error) else truth  # type: ignore[arg-type]
        return data, truth, spoilt
    assert folders.realdata is not None
    own, kitti = folders.realdata / case.data, folders.realdata / "kitti_odometry" / "sequences"
    data = load_dataset(own if own.is_dir() else kitti / case.data, interval_s=INTERVAL_S)
    later = int(case.kind.split()[0])
    pairs = zip(data.frames[: len(data.frames) - later], data.frames[later:], strict=True)
    frames = tuple(replace(one, image_paths=other.image_paths) for one, other in pairs)
    late = with_fields(truth, time_offset_s=later * INTERVAL_S)
    return replace(data, frames=frames), late, truth


def _wrong_rig(truth: Rig, seed: int) -> Rig:
    """The rig as it is stated: at the right pose, without times."""
    rig, wrong = truth, draw_wrong(seed)
    for part in ("focal", "centre", "distortion"):
        if part in wrong:
            rig = put_lens_error(rig, part, wrong[part])  # type: ignore[arg-type]
    return with_fields(rig, time_offset_s=None, readout_s=None)


def values_of(camera: Camera) -> dict[str, float]:
    """Parameters of a lens and a clock, as results name them."""
    k, packed = camera.intrinsics_px, camera.lens.packed
    numbers = COEFFICIENT_NUMBERS[camera.lens.kind]
    return {
        "focal": float(np.sqrt(k.fx * k.fy)), "centre_x": k.cx,
        "centre_y": k.cy,
        "offset": camera.time_offset_s or 0.0, "readout": camera.readout_s or 0.0,
        **{name: float(packed[4 + number]) for name, number in numbers.items()},
    }  # fmt: skip


def _to_record(result: Calibration, truth: Rig) -> Record:
    record = ledger.to_record(result, truth)
    for name, camera in record["cameras"].items():
        right = values_of(truth.cameras[name])
        camera["lens"] = [
            {**vars(one), "right": right[one.name], "z": (one.value - right[one.name]) / one.sigma}
            for one in result.lens.get(name, ())
        ]
    return record


def report_verdicts(level: str, records: Sequence[Record]) -> Table:
    """Verdicts by what was wrong."""
    heads = [(off, status) for off in (True, False) for status in STATUSES]
    rows = []
    for kind in dict.fromkeys(record["kind"] for record in records):
        cameras = [c for r in records if r["kind"] == kind for c in r.get("cameras", {}).values()]
        if cameras:
            counts = Counter((class_of(camera) == "off", camera["status"]) for camera in cameras)
            squares = [one["z"] ** 2 for camera in cameras for one in camera["lens"]]
            rows.append((
                kind, str(len(cameras)), *(str(counts[head]) for head in heads),
                *(f"{np.median([c[f'error_{u}'] for c in cameras]):.2f}" for u in ("deg", "cm")),
                f"{np.mean(squares):.2f}" if squares else "-",
            ))  # fmt: skip
    columns = ("wrong, estimated", "cases",
               *(f"{'off' if off else 'right'}: {status}" for off, status in heads),
               "median [deg]", "[cm]", "z^2 of the lens")  # fmt: skip
    return Table(f"{level}: cameras", columns, tuple(rows))


def main() -> None:
    """Run the cases that are left, and print the tables."""
    parser = ledger.case_parser(__doc__, "lens_cases")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=[*SETS])
    parser.add_argument("--data", type=lambda text: text.split(","), default=[], help="only these")
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "mixtures")
    parser.add_argument("--rigs", default="0:64", help="rendered ones")
    options = parser.parse_args()
    chosen = [
        case for case in cases(range(*map(int, options.rigs.split(":"))))
        if case.level in options.sets and (not options.data or case.data in options.data)
    ]  # fmt: skip
    options.scenes.mkdir(parents=True, exist_ok=True)
    work = partial(run_case, folders=Folders(options.realdata, None), scenes=options.scenes)
    records, tables = ledger.records_of(options, chosen, work), []
    for level in options.sets:
        own = [record for record in records if record["level"] == level]
        if own:
            tables.append(report_verdicts(level, own))
    ledger.publish_cases(tables, records)


if __name__ == "__main__":
    main()
