"""The matcher `structure` from far guesses: success, errors, verdicts and time.

    python benchmarks/search.py --data 00,00+01 --within 20/1.5,2/0.2 --out out/search.jsonl
    python benchmarks/search.py --kinds dark,half_beams --starts 3 --out out/spoilt.jsonl
    python benchmarks/search.py --summary out/search.jsonl

Guesses are drawn uniformly per axis, an independent draw per camera. A run is a success if every
camera ends within 0.5 deg and 15 cm of the reference. A wrong PASS is a camera farther off than
that which is called PASS, a wrong WARN likewise.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import ledger
import numpy as np
from data_cases import Folders, Scene, with_clouds, with_images
from ledger import Key, Record

from calibgraph import Camera, Dataset, Frame, calibrate, evaluate, perturb

SUCCESS_DEG, SUCCESS_CM = 0.5, 15.0
BEAM_DEG = 0.4  # about the spacing of 64 beams over 26 degrees


def main() -> None:
    """Run cases, print the table."""
    arguments = parsed()
    cases = [
        Key(within, kind, data, seed)
        for seed in range(arguments.first, arguments.first + arguments.starts)
        for within in arguments.within
        for kind in arguments.kinds
        for data in arguments.data
    ]
    work = partial(run_case, folders=Folders(arguments.realdata, None))
    records = ledger.records_of(arguments, cases, work)
    print(report(records))


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words: Callable[[str], list[str]] = lambda text: text.split(",")  # noqa: E731
    parser.add_argument("--data", type=words, default=["00", "00+01", "05", "05+06+07+08"])
    parser.add_argument("--within", type=words, default=["20/1.5", "10/0.5", "5/0.3", "2/0.2"])
    parser.add_argument("--kinds", type=words, default=["good"], help=", ".join(KINDS))
    parser.add_argument("--starts", type=int, default=20, help="draws per case")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--jobs", type=int, default=1, help="1 to measure time")
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    parser.add_argument("--out", type=Path, default=ledger.ROOT / "out" / "search.jsonl")
    parser.add_argument("--summary", type=Path, help="print the table of a file, run nothing")
    return parser.parse_args()


def run_case(case: Key, folders: Folders) -> Record:
    """Calibrate from one guess."""
    cv2.setNumThreads(2)
    data, truth = folders.load(case.data)
    degrees, metres = (float(number) for number in case.level.split("/"))
    guess = perturb(truth, rotation_deg=degrees, translation_m=metres, seed=case.seed, uniform=True)
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene(case.data, data, truth, folders, Path(folder), case.seed)
        result = calibrate(KINDS[case.kind](scene), guess)
    pairs = evaluate(result.rig, truth).pairs
    return {
        **ledger.judged(result, truth),
        "rig": result.verdict.status,
        "pairs": {
            name: [pair.rotation_error_deg, pair.translation_error_cm]
            for name, pair in pairs.items()
        },
        "stages_s": {stage: round(seconds, 2) for stage, seconds in result.timings_s.items()},
    }


def _good(scene: Scene) -> Dataset:
    return scene.data


def _no_intensity(scene: Scene) -> Dataset:
    return with_clouds(scene, lambda cloud: cloud[:, :3])


def _half_beams(scene: Scene) -> Dataset:
    """Every other band of elevation as wide as the spacing of the beams."""

    def every_other(cloud: Any) -> Any:
        elevation = np.degrees(np.arctan2(cloud[:, 2], np.hypot(cloud[:, 0], cloud[:, 1])))
        return cloud[np.floor(elevation / BEAM_DEG) % 2 == 0]

    return with_clouds(scene, every_other)


def _changed(
    scene: Scene, change: Callable[[Any], Any], chosen: Callable[[str], bool] = bool
) -> Dataset:
    """The images of the chosen cameras, changed."""

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        found = dict(frame.image_paths)
        for name in filter(chosen, frame.image_paths):
            camera: Camera = scene.truth.cameras[name]
            found[name] = scene.scratch / f"{name}_{frame.index:06d}.png"
            cv2.imwrite(str(found[name]), change(frame.load_image(name, camera)))
        return found

    return with_images(scene.data, paths)


def _dark(image: Any) -> Any:
    return (image * 0.15).astype(np.uint8)


def _over_exposed(image: Any) -> Any:
    """So bright that 10 % more of the image is white."""
    level = np.quantile(image[image < 255], 0.9)  # noqa: PLR2004
    return np.clip(image * (255.0 / level), 0, 255).astype(np.uint8)


KINDS: dict[str, Callable[[Scene], Dataset]] = {
    "good": _good,
    "no_intensity": _no_intensity,
    "half_beams": _half_beams,
    "dark": partial(_changed, change=_dark),
    "blurred": partial(_changed, change=lambda image: cv2.GaussianBlur(image, (0, 0), 2.0)),
    "over_exposed": partial(_changed, change=_over_exposed),
    "covered": partial(
        _changed, change=np.zeros_like, chosen=lambda name: name in ("image_3", "CAMERA_09")
    ),
}


def report(records: list[Record]) -> str:
    """A row per range, kind and data."""
    rows = sorted({(r["level"], r["kind"], r["data"]) for r in records}, key=_order)
    lines = [_HEAD, *(_row([r for r in records if _name(r) == row], row) for row in rows)]
    crashes = [r["crash"] for r in records if "crash" in r]
    return "\n".join([*lines, *crashes])


def _name(record: Record) -> tuple[str, str, str]:
    return record["level"], record["kind"], record["data"]


def _order(row: tuple[str, str, str]) -> tuple[float, str, str]:
    return -float(row[0].split("/")[0]), row[1], row[2]


_HEAD = (
    "deg/m    kind         data         runs success  median deg, cm  per camera"
    "            pairs        wrong PASS, WARN  PASS WARN FAIL refused  s: median, longest"
)


def _row(records: list[Record], row: tuple[str, str, str]) -> str:
    done = [r for r in records if "cameras" in r]
    cameras = [camera for r in done for camera in r["cameras"].values()]
    wrong = [c["status"] for c in cameras if not _right(c)]
    success = sum(all(_right(c) for c in r["cameras"].values()) for r in done)
    names = list(done[0]["cameras"]) if done else []
    each = "; ".join(_median([r["cameras"][name] for r in done]) for name in names)
    pairs = np.median([p for r in done for p in r["pairs"].values()] or [[np.nan] * 2], axis=0)
    statuses = [r["rig"] for r in done]
    seconds = [r["seconds"] for r in records]
    return (
        f"{row[0]:8} {row[1]:12} {row[2]:12} {len(records):4} {success:4}    "
        f"{_median(cameras):14}  {each:30}  {pairs[0]:.3f}, {pairs[1]:.2f}  "
        f"{wrong.count('PASS'):6} {wrong.count('WARN'):6}     "
        f"{statuses.count('PASS'):6} {statuses.count('WARN'):4} {statuses.count('FAIL'):4} "
        f"{len(records) - len(done):4}  {np.median(seconds):8.1f} {max(seconds):6.1f}"
    )


def _right(camera: Record) -> bool:
    return camera["error_deg"] < SUCCESS_DEG and camera["error_cm"] < SUCCESS_CM


def _median(cameras: list[Record]) -> str:
    values = [[c["error_deg"], c["error_cm"]] for c in cameras]
    degrees, centimetres = np.median(values, axis=0) if values else (np.nan, np.nan)
    return f"{degrees:.3f}, {centimetres:.2f}"


if __name__ == "__main__":
    main()
