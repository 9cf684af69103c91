"""What side cameras are worth: six cameras all round a vehicle, rendered standing and moving.

    python -m benchmarks.accuracy.sides --groups 0:1 --kinds standing,swept
    python -m benchmarks.accuracy.sides --summary out/sides.jsonl

A group is a rig with errors of its own and five streets that it drives through, three frames each:
one place. Most kinds have the same images, of one instant, and clouds that differ: ``standing``;
``swept``, at 10 m/s with the times of points, and not corrected; ``corrected``, the same by these
times; ``one_distance``, standing, with the points alone that are 7 to 12 m away and above the
ground. Of ``triggered`` the clouds are swept, and each image is taken when the LiDAR looks its way;
``timed`` is the same, with the interval of the clouds given, so that they are corrected.
Starts are 2 degrees and 10 cm off, or as ``--start`` says; rigs are six cameras with 64 or 32
beams, or four of 100 degrees. Errors are of the alignment of the cloud that stands.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.error_bars import (
    FRAMES,
    STEP_M,
    STREETS,
    calibrate_street,
    group_parser,
    load_streets,
    solve_streets,
)
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.tables import Table
from calibgraph import Intrinsics, Rig, load_rig, perturb
from calibgraph.simulation.lidar import lidar_of, ring_gains, scan
from calibgraph.simulation.recording import build_drive
from calibgraph.simulation.rigs import rig_of
from tests.draws.cameras import camera_at
from tools.scenes.lens_errors import draw_lens_errors
from tools.scenes.scan_errors import ScanErrors, draw_scan_errors
from tools.scenes.sensor_streets import ALIGNMENT, aligned_rig, render

TURN_S, TURN_M = 0.1, 1.0  # of the LiDAR, at 10 m/s
START_S = 1_700_000_000  # of stamps
KINDS = "standing", "swept", "corrected", "one_distance", "triggered", "timed"
SWEPT = "swept", "corrected", "triggered"
INTERVAL_S = STEP_M * TURN_S / TURN_M  # of the frames
START_DEG, START_M = 2.0, 0.1
WHERE = {"front": "front", "front_left": "front sides", "front_right": "front sides",
         "back_left": "back sides", "back_right": "back sides", "back": "back",
         "left": "sides", "right": "sides"}  # fmt: skip


def main() -> None:
    """Render, calibrate, keep a line of each."""
    parser = group_parser(__doc__, "sides", [0, 2])
    parser.set_defaults(scenes=parser.get_default("scenes").with_name("sides"))
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--streets", type=int, default=STREETS)
    parser.add_argument("--rigs", default="six", help=", ".join(RIGS))
    parser.add_argument("--start", default=f"{START_DEG:g}/{START_M:g}", help="degrees/metres off")
    arguments = parser.parse_args()
    cases = [
        Key(f"{rig} {arguments.start}", kind, f"{arguments.size:g}", STREETS * group + street)
        for rig in arguments.rigs.split(",")
        for group in range(*arguments.groups)
        for street in range(arguments.streets)
        for kind in arguments.kinds.split(",")
    ]
    work = partial(run_case, scenes=arguments.scenes)
    records = ledger.records_of(arguments, cases, work)
    ledger.publish_cases([report(records), *together(records, arguments.scenes)], records)


def six_cameras() -> Rig:
    """The rig ``surround`` with images of half the size."""
    cameras = {}
    for name, camera in rig_of("surround").cameras.items():
        k = camera.intrinsics_px
        half = {side: getattr(k, side) / 2 for side in ("fx", "fy")}
        half |= {side: (getattr(k, side) - 0.5) / 2 for side in ("cx", "cy")}
        size = {"width_px": camera.width_px // 2, "height_px": camera.height_px // 2}
        cameras[name] = camera.model_copy(update={**size, "intrinsics_px": Intrinsics(**half)})
    return Rig(cameras=cameras)


def four_cameras() -> Rig:
    """Four cameras of 100 degrees, at heights of their own."""
    lens = Intrinsics(fx=268.5, fy=268.5, cx=319.5, cy=199.5)
    views = {"front": ((0.9, 0.0, -0.3), 0.0), "left": ((0.2, 0.8, -0.7), 90.0),
             "back": ((-0.8, 0.1, 0.1), 180.0), "right": ((0.1, -0.8, -0.6), -90.0)}  # fmt: skip
    return Rig(cameras={name: camera_at((640, 400), lens, *view) for name, view in views.items()})


RIGS = {"six": (six_cameras, 64), "sparse": (six_cameras, 32), "four": (four_cameras, 64)}
"""Cameras and beams."""


def folder_of(key: Record, scenes: Path) -> Path:
    """Where the street of a case is."""
    rig = key["level"].split()[0]
    return scenes / f"{'scene' if rig == 'six' else rig}_{key['seed']}"


def run_case(case: Key, scenes: Path) -> Record:
    """Make the data of a kind, calibrate, keep the tables beside them."""
    size, group, kind = float(case.data), case.seed // STREETS, case.kind
    rig, start = case.level.split()
    make, beams = RIGS[rig]
    truth, root = make(), folder_of(asdict(case), scenes)
    stated = draw_lens_errors(truth, size / 2, np.random.default_rng([13, group]))
    still = replace(draw_scan_errors(beams, size, np.random.default_rng([7, group])), motion_m=0.0)
    first, folder = root / "standing", root / kind
    if not (first / ALIGNMENT).exists():
        drive = {"frames": FRAMES, "step_m": STEP_M, "seed": 7000 + case.seed}
        render(first, truth, beams, still, **drive)
        aligned_rig(truth, stated, first, beams, still).save(first / ALIGNMENT)
    if not folder.exists():
        _derive(folder, first, still, case)
    aligned = load_rig(first / ALIGNMENT)
    for rig, name in ((stated, "reference.yaml"), (aligned, ALIGNMENT)):
        rig.save(folder / name)
    degrees, metres = map(float, start.split("/"))
    guess = perturb(stated, rotation_deg=degrees, translation_m=metres, seed=case.seed)
    result = calibrate_street(folder, guess, interval_s=INTERVAL_S if kind == "timed" else None)
    return ledger.to_record(result, aligned)


def _derive(folder: Path, first: Path, still: ScanErrors, case: Key) -> None:
    """The images of the street that is rendered, with other clouds."""
    if case.kind == "timed":
        folder.mkdir()
        if not (triggered := folder.with_name("triggered")).exists():
            _derive(triggered, first, still, replace(case, kind="triggered"))
        for name in ("cameras", "lidar"):
            (folder / name).symlink_to(f"../triggered/{name}")
        return
    (folder / "lidar").mkdir(parents=True)
    if case.kind == "triggered":
        _render_triggered(folder, still, case)
    else:
        (folder / "cameras").symlink_to(os.path.relpath(first / "cameras", folder))
    clouds = [np.load(path) for path in sorted((first / "lidar").glob("*.npy"))]
    if case.kind in SWEPT:
        drive = build_drive(frames=FRAMES, step_m=STEP_M, seed=7000 + case.seed, vary_layout=True)
        lidar = replace(
            lidar_of(RIGS[case.level.split()[0]][1]), errors=replace(still, motion_m=TURN_M)
        )
        gains = ring_gains(lidar, np.random.default_rng([case.seed, 2]))
        clouds = [
            scan(drive.world, lidar, gains, T, rng=np.random.default_rng([case.seed, 3, frame]))
            for frame, T in enumerate(drive.T_world_lidar)
        ]
    change = {"corrected": _at_one_instant, "one_distance": _walls}.get(case.kind, _with_times)
    for frame, cloud in enumerate(clouds):
        name = _stamp(frame, 0.0) if case.kind == "triggered" else f"{frame:06d}"
        np.save(folder / "lidar" / f"{name}.npy", change(cloud))


def _render_triggered(folder: Path, still: ScanErrors, case: Key) -> None:
    """Images that are taken when the LiDAR looks where their camera looks; stamps name them."""
    make, beams = RIGS[case.level.split()[0]]
    truth, late_s, moved = make(), {}, {}
    for name, camera in truth.cameras.items():
        T = camera.T_camera_lidar.copy()
        heading = np.arctan2(T[2, 1], T[2, 0])
        late_s[name] = TURN_S * heading / (2 * np.pi)
        T[:3, 3] -= T[:3, 0] * TURN_M * late_s[name] / TURN_S  # it has driven so far
        moved[name] = T
    drive = {"frames": FRAMES, "step_m": STEP_M, "seed": 7000 + case.seed}
    rendered = folder.with_name("rendered")
    render(rendered, truth.moved_to(moved), beams, still, **drive)
    for name, seconds in late_s.items():
        for frame, image in enumerate(sorted((rendered / "cameras" / name).glob("*"))):
            there = folder / "cameras" / name / f"{_stamp(frame, seconds)}{image.suffix}"
            there.parent.mkdir(parents=True, exist_ok=True)
            image.rename(there)


def _stamp(frame: int, late_s: float) -> str:
    stamp_ns = START_S * 10**9 + round((frame * INTERVAL_S + late_s) * 1e9)
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _with_times(cloud: np.ndarray) -> np.ndarray:
    """The points of a sweep with their times [s] after the LiDAR looked ahead."""
    times_s = TURN_S * np.arctan2(cloud[:, 1], cloud[:, 0]) / (2 * np.pi)
    names = [(name, "f4") for name in ("x", "y", "z", "intensity", "t")]
    return np.array([*map(tuple, np.column_stack([cloud[:, :4], times_s]))], dtype=names)


def _at_one_instant(cloud: np.ndarray) -> np.ndarray:
    """The points of a sweep where the LiDAR at the instant of the images sees them."""
    moved = cloud.copy()
    moved[:, 0] += TURN_M * np.arctan2(cloud[:, 1], cloud[:, 0]) / (2 * np.pi)
    return moved


def _walls(cloud: np.ndarray) -> np.ndarray:
    """The points above the ground that are 7 to 12 m away."""
    away = np.hypot(cloud[:, 0], cloud[:, 1])
    return np.asarray(cloud[(away > 7.0) & (away < 12.0) & (cloud[:, 2] > -1.5)])  # noqa: PLR2004


COLUMNS = (
    "cameras", "results", "error, median [deg]", "largest", "[cm]", "largest", "within",
    "sigma, median [deg]", "[cm]", "mean NEES / 6", "PASS, WARN, FAIL",
)  # fmt: skip


def _cells(found: Sequence[Record], within: tuple[float, float]) -> tuple[str, ...]:
    deg, cm = (np.array([one[f"error_{unit}"] for one in found]) for unit in ("deg", "cm"))
    known = [one for one in found if one.get("covariance")]  # of streets together it is not kept
    bars = np.array([np.sqrt(np.diag(one["covariance"])) for one in known] or [np.full(6, np.nan)])
    sigma = np.median(bars.reshape(-1, 2, 3).max(axis=2), axis=0) * (np.degrees(1.0), 100.0)
    nees = [one["normalised_squared"] for one in found if one.get("normalised_squared")]
    status = [one["status"] for one in found]
    inside = ((deg <= within[0]) & (cm <= within[1])).sum()
    return (
        str(len(found)), f"{np.median(deg):.3f}", f"{deg.max():.2f}", f"{np.median(cm):.1f}",
        f"{cm.max():.1f}", str(inside), f"{sigma[0]:.3f}", f"{sigma[1]:.1f}",
        f"{np.mean(nees):.2f}", ", ".join(str(status.count(s)) for s in ("PASS", "WARN", "FAIL")),
    )  # fmt: skip


def of_record(record: Record) -> tuple[str, str]:
    """Rig with start, and kind."""
    return record["level"], record["kind"]


def report(records: Sequence[Record]) -> Table:
    """A row per kind and kind of camera, of single places; within 0.15 deg and 5 cm."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    for record in records:
        for name, camera in record.get("cameras", {}).items():
            groups.setdefault((*of_record(record), WHERE[name]), []).append(camera)
    rows = tuple((*key, *_cells(of, (0.15, 5.0))) for key, of in sorted(groups.items()))
    return Table(
        "One street of three frames, errors and bars per camera",
        ("rig, start", "cloud", *COLUMNS),
        rows,
    )


def together(records: Sequence[Record], scenes: Path) -> list[Table]:
    """The same of the five streets of a group together; within 0.08 deg and 2 cm."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    streets: dict[tuple[str, str, int], list[Path]] = {}
    for record in sorted(records, key=lambda record: record["seed"]):
        if "cameras" in record:
            key = *of_record(record), record["seed"] // STREETS
            streets.setdefault(key, []).append(folder_of(record, scenes) / record["kind"])
    for (rig, kind, _), folders in streets.items():
        if len(folders) == STREETS:
            found = [one for of, one in solve_streets(load_streets(folders)) if of == "camera"]
            for name, one in zip(load_rig(folders[0] / ALIGNMENT).cameras, found, strict=True):
                groups.setdefault((rig, kind, WHERE[name]), []).append(one)
    rows = tuple((*key, *_cells(of, (0.08, 2.0))) for key, of in sorted(groups.items()))
    return [Table("Five streets together", ("rig, start", "cloud", *COLUMNS), rows)]


if __name__ == "__main__":
    main()
