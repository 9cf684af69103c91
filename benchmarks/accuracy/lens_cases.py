"""Recordings with lenses and clocks that are wrong, right or unknown, and ``--estimate``.

    python -m benchmarks.accuracy.lens_cases [--sets spoilt right unknown] [--data 05,06] [--jobs 2]

``spoilt``: KITTI's lenses are wrong by what the docs of the verdict list, fixed and estimated, and
the distortion is estimated where nothing was spoilt. ``right``: the whole lens, or the offset, is
estimated where nothing is wrong, beside the same without: which parameters leave their prior, how
far cameras move in standard deviations, how much longer it takes. ``unknown``: recordings with
distortion that the rig states as zero. All start 1 degree and 10 cm off; errors are against the
reference. Cases are kept in ``--out``, a line each; a stopped run continues.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.lens import values_of
from benchmarks.accuracy.scenes import Folders
from benchmarks.accuracy.verdicts import STATUSES, class_of
from benchmarks.tables import Table
from calibgraph import Calibration, Config, Dataset, Rig, calibrate, evaluate, load_dataset, perturb
from calibgraph.model.geometry import twist_between
from calibgraph.model.rig import Camera
from tests.draws.lenses import put_lens_error

KITTI = ("05", "06", "07", "08", "06+07+08")
SPOILT = (
    ("focal", 0.03), ("focal", 0.05), ("centre", 20.0), ("distortion", 0.05)
)  # fmt: skip
OTHER_RIGS = (
    "surround6", "nuscenes_a", "dgp_scene01", "opencalib_a", "vlp16_distorted",
    "acfr_vlp16_fisheye",
)  # fmt: skip
DRIVES = ("00", "05", "06", "07", "08", "kitti_raw_0005")
DISTORTED = ("vlp16_distorted", "opencalib_a", "acfr_vlp16_fisheye")
INTERVAL_S, START_DEG, START_M, SEED = 0.1, 1.0, 0.1, 1
FAR_SIGMAS = 3.0
WIDE_SIGMA = 0.3  # of radial coefficients, where nothing is known of them
FIXED = "fixed"


def cases(chosen: Sequence[str], data: Sequence[str]) -> Iterator[Key]:
    """The cases of some sets, by their kind: part, error and what is estimated."""
    every = {
        "spoilt": [
            *((f"{part} {error:g} {how}", name) for name in KITTI for part, error in SPOILT
              for how in (FIXED, part)),
            *(("distortion 0 distortion", name) for name in ("07", "08")),
        ],
        "right": [
            *(("lens", name) for name in OTHER_RIGS), *(("offset", name) for name in DRIVES)
        ],
        "unknown": [
            (kind, name) for name in DISTORTED for kind in ("right", "zero", "default", "wide")
        ],
    }  # fmt: skip
    for level in chosen:
        for kind, name in every[level]:
            if not data or name in data:
                yield Key(level, kind, name, SEED)


def run_case(case: Key, folders: Folders) -> Record:
    """One case by its set."""
    return {"spoilt": _spoilt, "right": _right, "unknown": _unknown}[case.level](case, folders)


def _spoilt(case: Key, folders: Folders) -> Record:
    part, error, how = case.kind.split()
    data, truth = folders.load(case.data)
    wrong = put_lens_error(truth, part, float(error)) if float(error) else truth  # type: ignore[arg-type]
    result, _ = _calibrate(data, wrong, "" if how == FIXED else how)
    return _to_record(result, truth)


def _right(case: Key, folders: Folders) -> Record:
    """Without and with the estimate, each from the files."""
    found = []
    for estimate in ("", case.kind):
        data, truth = _with_motion(case, folders)
        found.append(_calibrate(data, truth, estimate))
    (before, before_s), (after, after_s) = found
    record = _to_record(after, truth)
    for name, camera in record["cameras"].items():
        camera["before"] = before.camera_verdicts[name].status
        camera["moved_sigmas"] = _moved(before, after, name)
    return {**record, "cpu_ratio": after_s / before_s, "cpu_s": before_s}


def _unknown(case: Key, folders: Folders) -> Record:
    """The right lens and one without distortion fixed; then this estimated, with two priors."""
    data, truth = folders.load(case.data)
    sigma = WIDE_SIGMA if case.kind == "wide" else None
    cameras = {
        name: c.model_copy(
            update={"distortion": _without(c), "distortion_sigma": sigma or c.distortion_sigma}
        )
        for name, c in truth.cameras.items()
    }
    rig = truth if case.kind == "right" else truth.model_copy(update={"cameras": cameras})
    result, _ = _calibrate(data, rig, "distortion" if case.kind in ("default", "wide") else "")
    return _to_record(result, truth)


def _without(camera: Camera) -> tuple[float, ...]:
    """Zeros for the coefficients that are distortion: xi of a unified lens stays."""
    kept = camera.distortion[:1] if camera.model == "omnidirectional" else ()
    return (*kept, *[0.0] * (len(camera.distortion) - len(kept)))


def _with_motion(case: Key, folders: Folders) -> tuple[Dataset, Rig]:
    """Recordings of drives with the motion of their LiDAR, for an offset."""
    data, truth = folders.load(case.data)
    if case.kind != "offset" or folders.realdata is None:
        return data, truth
    own = folders.realdata / case.data
    drive = own if own.is_dir() else folders.realdata / "kitti_odometry" / "sequences" / case.data
    return load_dataset(drive, interval_s=INTERVAL_S), truth


def _calibrate(data: Dataset, rig: Rig, estimate: str) -> tuple[Calibration, float]:
    """The result, and the processor time [s]."""
    guess = perturb(rig, rotation_deg=START_DEG, translation_m=START_M, seed=SEED)
    before = time.process_time()
    result = calibrate(data, guess, config=Config(estimate=estimate or ()))
    return result, time.process_time() - before


def _to_record(result: Calibration, truth: Rig) -> Record:
    record = ledger.to_record(result, truth)
    corners_px = evaluate(result.rig, truth).lens_px
    for name, camera in record["cameras"].items():
        right = values_of(truth.cameras[name])
        camera["corners_px"] = corners_px.get(name, 0.0)
        camera["lens"] = [
            {
                **vars(one),
                "is_determined": one.is_determined,
                "right": right[one.name],
                "z": (one.value - right[one.name]) / one.sigma,
            }
            for one in result.lens.get(name, ())
        ]
    return record


def _moved(before: Calibration, after: Calibration, name: str) -> float | None:
    """Root mean square over six axes of a camera's step, in the error bar without the estimate."""
    covariance = before.covariance[name]
    if covariance is None:
        return None
    step = twist_between(after.T_camera_lidar[name], before.T_camera_lidar[name])
    return float(np.sqrt(step @ np.linalg.solve(covariance, step) / len(step)))


def report_spoilt(records: Sequence[Record]) -> list[Table]:
    """Verdicts by what was wrong, and a row per case."""
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
    return [Table("Spoilt lenses: cameras", columns, tuple(rows)), _details(records)]


def report_right(records: Sequence[Record]) -> list[Table]:
    """A row per case, and all of them."""
    columns = (
        "estimated", "recording", "parameters", f"beyond {FAR_SIGMAS:g} prior sigmas", "largest",
        "moved, largest [sigma]", "verdicts before", "after", "time ratio",
    )  # fmt: skip
    rows, every = [], list[float]()
    for record in records:
        cameras = record.get("cameras", {}).values()
        left = [abs(one["value"] - one["prior"]) / one["prior_sigma"]
                for camera in cameras for one in camera["lens"]]  # fmt: skip
        moved = [c["moved_sigmas"] for c in cameras if c["moved_sigmas"] is not None]
        verdicts = (Counter(camera[key] for camera in cameras) for key in ("before", "status"))
        rows.append((
            record["kind"], record["data"], str(len(left)), str(sum(z > FAR_SIGMAS for z in left)),
            f"{max(left, default=0):.2f}", f"{max(moved, default=np.nan):.2f}",
            *(", ".join(f"{n} {status}" for status, n in sorted(found.items())) or "refused"
              for found in verdicts), f"{record.get('cpu_ratio', np.nan):.2f}",
        ))  # fmt: skip
        every += left
    rows.append(("all", "", str(len(every)), str(sum(z > FAR_SIGMAS for z in every)), *[""] * 5))
    return [Table("Nothing wrong", columns, tuple(rows))]


def _details(records: Sequence[Record]) -> Table:
    """A row per camera."""
    columns = (
        "recording", "case", "camera", "verdict", "[deg]", "[cm]", "corners [px]",
        "the parameter farthest off, in sigmas", "sigma",
    )  # fmt: skip
    rows = [
        (record["data"], record["kind"], name, camera["status"], f"{camera['error_deg']:.3f}",
         f"{camera['error_cm']:.1f}", f"{camera['corners_px']:.1f}", *_farthest(camera))
        for record in records
        for name, camera in record.get("cameras", {}).items()
    ]  # fmt: skip
    rows += [(r["data"], r["kind"], "refused or crashed", *[""] * 6)
             for r in records if "cameras" not in r]  # fmt: skip
    return Table("Cameras", columns, tuple(rows))


def _farthest(camera: Record) -> tuple[str, str]:
    one = max(camera["lens"], key=lambda each: abs(each["z"]), default=None)
    if one is None:
        return "-", "-"
    error = one["value"] - one["right"]
    return f"{one['name']} {error:+.3g}: {one['z']:+.1f}", f"{one['sigma']:.2g}"


REPORTS = {
    "spoilt": report_spoilt,
    "right": report_right,
    "unknown": lambda records: [_details(records)],
}


def main() -> None:
    """Run the cases that are left, and print the tables."""
    parser = ledger.case_parser(__doc__, "lens_cases")
    parser.add_argument("--sets", nargs="+", choices=[*REPORTS], default=[*REPORTS])
    parser.add_argument("--data", type=lambda text: text.split(","), default=[], help="only these")
    parser.add_argument("--kind", help="only cases of this kind, as 'focal 0.03 fixed'")
    options = parser.parse_args()
    chosen = [
        case for case in cases(options.sets, options.data) if options.kind in (None, case.kind)
    ]
    work = partial(run_case, folders=Folders(options.realdata, None))
    records = ledger.records_of(options, chosen, work)
    tables = [
        table
        for level, report in REPORTS.items()
        if (own := [record for record in records if record["level"] == level])
        for table in report(own)
    ]
    ledger.publish_cases("accuracy.lens_cases", tables, records, record=options.record)


if __name__ == "__main__":
    main()
