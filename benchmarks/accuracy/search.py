"""The matcher `structure` from far guesses: success, errors, verdicts and time.

    python -m benchmarks.accuracy.search --data 00,00+01 --within 20/1.5,2/0.2
    python -m benchmarks.accuracy.search --kinds one_frame,two_frames --within 10/0.5 --starts 6
    python -m benchmarks.accuracy.search --summary out/search.jsonl --cameras

Guesses are drawn uniformly per axis, independently per camera. A run is a success if every camera
ends within 0.5 deg and 15 cm of the reference. A wrong PASS or WARN is a camera farther off than
that with this verdict. ``--cameras`` adds a row per camera, with its error bar and the squared
error over the variance of each axis (1 is expected).
"""

from collections import Counter
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import Folders
from benchmarks.tables import Table
from calibgraph import Dataset, calibrate, evaluate, perturb

SUCCESS_DEG, SUCCESS_CM = 0.5, 15.0
STATUSES = ("PASS", "WARN", "FAIL")


def main() -> None:
    """Run cases, print the table."""
    words: Callable[[str], list[str]] = lambda text: text.split(",")  # noqa: E731
    parser = ledger.case_parser(__doc__, "search")
    parser.add_argument("--data", type=words, default=["00", "00+01", "05", "05+06+07+08"])
    parser.add_argument("--within", type=words, default=["20/1.5", "10/0.5", "5/0.3", "2/0.2"])
    parser.add_argument("--kinds", type=words, default=["good"], help=", ".join(KINDS))
    parser.add_argument("--starts", type=int, default=20, help="draws per case")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--cameras", action="store_true", help="a row per camera, too")
    arguments = parser.parse_args()
    cases = [
        Key(within, kind, data, seed)
        for seed in range(arguments.first, arguments.first + arguments.starts)
        for within in arguments.within
        for kind in arguments.kinds
        for data in arguments.data
    ]
    work = partial(run_case, folders=Folders(arguments.realdata, None))
    records = ledger.records_of(arguments, cases, work)
    tables = [report(records), *([per_camera(records)] if arguments.cameras else [])]
    ledger.publish_cases(tables, records)


def run_case(case: Key, folders: Folders) -> Record:
    """Calibrate from one guess."""
    cv2.setNumThreads(2)
    data, truth = folders.load(case.data)
    degrees, metres = (float(number) for number in case.level.split("/"))
    guess = perturb(truth, rotation_deg=degrees, translation_m=metres, seed=case.seed, uniform=True)
    result = calibrate(KINDS[case.kind](data, case.seed), guess)
    pairs = evaluate(result.rig, truth).pairs
    table = result.correspondences
    return {
        **ledger.to_record(result, truth),
        "places": None if table is None else len(table.places.split(np.unique(table.frame))),
        "rig": result.verdict.status,
        "pairs": {
            name: [pair.rotation_error_deg, pair.translation_error_cm]
            for name, pair in pairs.items()
        },
        "stages_s": {stage: round(seconds, 2) for stage, seconds in result.timings_s.items()},
    }


def _few(data: Dataset, seed: int, frames: int) -> Dataset:
    """So many frames, from one that the seed chooses."""
    first = seed % (len(data.frames) - frames + 1)
    return data.only(data.frames[first : first + frames])


KINDS: dict[str, Callable[[Dataset, int], Dataset]] = {
    "good": lambda data, seed: data,
    "one_frame": partial(_few, frames=1),
    "two_frames": partial(_few, frames=2),
}


COLUMNS = (
    "within [deg/m]", "kind", "data", "runs", "successes", "median [deg]", "[cm]",
    "pairs [deg]", "[cm]", "wrong PASS", "wrong WARN", "PASS", "WARN",
    "FAIL", "refused", "time, median [s]", "longest [s]",
)  # fmt: skip


def report(records: list[Record]) -> Table:
    """A row per range, kind and data."""
    groups: dict[tuple[str, str, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record["level"], record["kind"], record["data"]), []).append(record)
    rows = [cells(name, groups[name]) for name in sorted(groups, key=_order)]
    return Table("Recorded KITTI frames, guesses of any size", COLUMNS, tuple(rows))


def _order(row: tuple[str, str, str]) -> tuple[float, str, str]:
    return -float(row[0].split("/")[0]), row[1], row[2]


def cells(name: tuple[str, str, str], records: list[Record]) -> tuple[str, ...]:
    """The row of a range, kind and data."""
    done = [r for r in records if "cameras" in r]
    cameras = [camera for r in done for camera in r["cameras"].values()]
    wrong = [c["status"] for c in cameras if not _is_right(c)]
    successes = sum(all(_is_right(c) for c in r["cameras"].values()) for r in done)
    pairs = np.median([p for r in done for p in r["pairs"].values()] or [[np.nan] * 2], axis=0)
    statuses = [r["rig"] for r in done]
    seconds = [r["seconds"] for r in records]
    degrees, centimetres = _median_errors(cameras)
    return (
        *name, str(len(records)), str(successes), f"{degrees:.3f}", f"{centimetres:.2f}",
        f"{pairs[0]:.3f}", f"{pairs[1]:.2f}",
        *(str(wrong.count(status)) for status in ("PASS", "WARN")),
        *(str(statuses.count(status)) for status in STATUSES),
        str(len(records) - len(done)), f"{np.median(seconds):.1f}", f"{max(seconds):.1f}",
    )  # fmt: skip


CAMERA_COLUMNS = (
    "within [deg/m]", "kind", "data", "camera", "places", "starts", "refused",
    "median [deg]", "[cm]", "sigma [deg]", "[cm]", "squared error over variance: rotation x, y, z",
    "translation x, y, z", "in the covariance, over 6",
    *(f"{which}: {status}" for which in ("found", "not found") for status in STATUSES),
)  # fmt: skip


def per_camera(records: list[Record]) -> Table:
    """A row per range, kind, data and camera; sigmas are of the worst axis, of results not FAIL."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    for record in records:
        for name, camera in record.get("cameras", {}).items():
            case = (record["level"], record["kind"], record["data"], name)
            groups.setdefault(case, []).append({"places": record.get("places"), **camera})
    refused = Counter((r["level"], r["kind"], r["data"]) for r in records if "refusal" in r)
    rows = [camera_cells(name, groups[name], refused[name[:3]]) for name in groups]
    return Table("Each camera", CAMERA_COLUMNS, tuple(rows))


def camera_cells(name: tuple[str, ...], cameras: list[Record], refused: int) -> tuple[str, ...]:
    """The row of a camera over all starts."""
    places = "/".join(sorted({str(c["places"]) for c in cameras if c["places"] is not None}))
    with_bar = [c for c in cameras if c["sigma_deg"] is not None and c["status"] != "FAIL"]
    errors = (f"{error:.2f}" for error in _median_errors(cameras))
    sigmas = (_median([max(c[key]) for c in with_bar]) for key in ("sigma_deg", "sigma_cm"))
    ratios = (
        ", ".join(_mean([(c[f"xi_{u}"][i] / c[f"sigma_{u}"][i]) ** 2 for c in with_bar])
                  for i in range(3 if with_bar else 0))
        for u in ("deg", "cm")
    )  # fmt: skip
    verdicts = Counter((_is_right(c), c["status"]) for c in cameras)
    return (
        *name, places, str(len(cameras) + refused), str(refused), *errors, *sigmas, *ratios,
        _mean([c["normalised_squared"] for c in with_bar]),
        *(str(verdicts[found, status]) for found in (True, False) for status in STATUSES),
    )  # fmt: skip


def _median(values: list[float]) -> str:
    return f"{np.median(values):.2f}" if values else ""


def _mean(values: list[float]) -> str:
    return f"{np.mean(values):.1f}" if values else ""


def _is_right(camera: Record) -> bool:
    return camera["error_deg"] < SUCCESS_DEG and camera["error_cm"] < SUCCESS_CM


def _median_errors(cameras: list[Record]) -> tuple[float, float]:
    """Rotation [deg] and translation [cm]; NaN of no cameras."""
    if not cameras:
        return np.nan, np.nan
    degrees, centimetres = np.median([[c["error_deg"], c["error_cm"]] for c in cameras], axis=0)
    return float(degrees), float(centimetres)


if __name__ == "__main__":
    main()
