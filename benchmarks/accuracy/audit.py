"""How often ``check`` finds what has moved, and how often something where nothing has.

    python -m benchmarks.accuracy.audit [--scenes 48] [--repeats 3]
    python -m benchmarks.accuracy.audit --summary out/audit.jsonl

Recordings with KITTI's calibration, and rendered streets with a LiDAR that errs: two frames of each
of three streets. What is deployed is right (the reference, the true alignment, or the result of
another recording of that rig); or one camera, or the LiDAR, is displaced along one axis: by sizes
in degrees and centimetres, and by multiples of the smallest change that the audit of the right rig
states. Data, cameras and signs change from case to case.

An axis is significant, as the audit itself decides it, where its deviation is beyond what one of
1000 right rigs shows; counted of cameras whose measurement the audit trusts.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import GUESS_DEG, GUESS_M, Folders
from benchmarks.tables import Table
from calibgraph import (
    Audit,
    CalibrationError,
    CameraAudit,
    Dataset,
    Rig,
    calibrate,
    check,
    load_dataset,
    load_rig,
    perturb,
)
from calibgraph.audit.judgement import CAMERA_AXES, FALSE_ALARM_RATE, POWER, Limits
from calibgraph.audit.result import by_unit
from tools.scenes.scan_errors import draw_scan_errors
from tools.scenes.sensor_streets import ALIGNMENT, RIGS, aligned_rig, mean_poses, render

Array = NDArray[np.float64]

LIDAR = "LiDAR"
SIZES = {"deg": (0.1, 0.2, 0.5, 1.0, 2.0), "cm": (1.0, 2.0, 5.0, 10.0, 20.0)}
TIMES = (0.5, 0.75, 1.0, 1.25, 1.5)
UNITS = ("deg",) * 3 + ("cm",) * 3
PER_UNIT = np.repeat([np.pi / 180, 0.01], 3)  # rad or m

RECORDINGS = ("00", "05", "06", "07", "08", "05+06+07+08", "kitti_raw_0005")
ONE_RIG = ("05", "06", "07", "08")
"""Of one rig: the result of each is also taken for what is deployed when another is audited."""
ENOUGH = ("00", "05", "kitti_raw_0005")
"""Of enough frames for an answer, and not longer than needed."""

DISPLACED_SCENES = 24
STREETS, FRAMES, STEP_M = 3, 2, 8.0
SENSOR_ERRORS = 1.0
_SEED = 4000


def load(name: str, folders: Folders) -> tuple[Dataset, Rig]:
    """Data by name, and the right rig; a scene is rendered if it is not there yet.

    Of a scene cameras are at their alignments: where their LiDAR, which errs, sees them.
    """
    if not name.startswith("scene_"):
        return folders.load(name)
    assert folders.scenes is not None
    streets = render_streets(folders.scenes / name, int(name.removeprefix("scene_")))
    aligned = mean_poses([load_rig(street / ALIGNMENT).T_camera_lidar for street in streets])
    return load_dataset(streets), load_rig(streets[0] / "reference.yaml").moved_to(aligned)


def render_streets(scene: Path, number: int) -> list[Path]:
    """Folders of the streets through which one sensor drove, each a place of its own."""
    _, make_rig, beams = RIGS[number % len(RIGS)]
    streets = [scene / f"street_{street}" for street in range(STREETS)]
    errors = draw_scan_errors(beams, SENSOR_ERRORS, np.random.default_rng([8, number]))
    for street, folder in enumerate(streets):
        if not (folder / ALIGNMENT).exists():
            seed = _SEED + STREETS * number + street
            render(folder, make_rig(), beams, errors, frames=FRAMES, step_m=STEP_M, seed=seed)
            truth = load_rig(folder / "reference.yaml")
            aligned_rig(truth, truth, folder, beams, errors).save(folder / ALIGNMENT)
    return streets


def right_rig(kind: str, truth: Rig, folders: Folders) -> Rig:
    """The truth or reference, or the rig as ``calibrate`` finds it from another recording."""
    name = kind.removeprefix("result of ")
    if name == kind:
        return truth
    assert folders.scenes is not None
    path = folders.scenes / f"result_{name}.yaml"
    if not path.exists():
        data, reference = load(name, folders)
        guess = perturb(reference, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=0)
        calibrate(data, guess).rig.save(path)
    return load_rig(path)


def ring() -> list[str]:
    """Data to displace, to go round in: three scenes, one recording, and so on; of odd length."""
    names = []
    for number in range(DISPLACED_SCENES):
        names.append(f"scene_{number}")
        if number % 3 == 2:
            names.append(ENOUGH[number // 3 % len(ENOUGH)])
    return names[:-1]


Stated = Mapping[tuple[str, str], Array]
"""(6,) smallest detectable changes [rad, m] of a camera, by data and camera."""


def main() -> None:
    """Audit what is right, then what is displaced; print the tables."""
    parser = ledger.case_parser(__doc__, "audit")
    parser.add_argument("--scenes", type=int, default=48, help="right ones, a sensor each")
    parser.add_argument("--repeats", type=int, default=3, help="of each axis and size of a camera")
    options = parser.parse_args()
    folders = Folders(options.realdata, options.out.with_suffix(""))
    if options.summary is not None:
        records = ledger.read(options.summary)
    else:
        work = partial(run_case, folders=folders, stated={})
        records = ledger.run(right_cases(options.scenes), work, out=options.out, jobs=options.jobs)
        work = partial(run_case, folders=folders, stated=dict(stated_by(records)))
        cases = displaced_cases(ring(), options.repeats)
        records = ledger.run(cases, work, out=options.out, jobs=options.jobs)
    ledger.publish_cases(report(records), records)


def right_cases(scenes: int) -> list[Key]:
    """Nothing is displaced."""
    of_results = [(a, b) for a in ONE_RIG for b in ONE_RIG if a != b]
    return [
        *(Key("right", "reference", name, 0) for name in RECORDINGS),
        *(Key("right", f"result of {of}", name, 0) for of, name in of_results),
        *(Key("right", "truth", f"scene_{number}", 0) for number in range(scenes)),
    ]


def displaced_cases(names: list[str], repeats: int) -> list[Key]:
    """Every axis and size, again and again with other data, cameras and signs.

    Args:
        names: of the data, to go round in.
        repeats: of a camera's sizes; of the LiDAR's and of multiples of the detectable change two.
    """
    cases = list[Key]()
    for repeat in range(max(repeats, 2)):
        for level, count in (("camera", repeats), ("detectable", 2), (LIDAR, 2)):
            for axis, step in np.ndindex(6, len(TIMES)) if repeat < count else ():
                size = TIMES[step] if level == "detectable" else SIZES[UNITS[axis]][step]
                sign = 1 - 2 * ((repeat + axis + step) % 2)
                number = len(cases)
                kind = f"{axis}:{sign * size:g}"
                cases.append(Key(level, kind, names[number % len(names)], number))
    return cases


def run_case(case: Key, folders: Folders, stated: Stated) -> Record:
    """Audit one deployed rig."""
    data, truth = load(case.data, folders)
    if case.level == "right":
        return to_record(check(right_rig(case.kind, truth, folders), data))
    of, axis, size = displacement(case, list(truth.cameras), stated)
    audit = check(deployed(truth, of, size * np.eye(6)[axis]), data)
    return {"of": of, "axis": axis, "size": size / PER_UNIT[axis], **to_record(audit)}


def displacement(case: Key, cameras: list[str], stated: Stated) -> tuple[str, int, float]:
    """What is displaced, its axis, and the size [rad or m]; a camera is drawn by the case's number.

    Raises:
        CalibrationError: if the audit of the right rig states no smallest detectable change.
    """
    axis, size = int(case.kind.split(":")[0]), float(case.kind.split(":")[1])
    if case.level == LIDAR:
        return LIDAR, axis, size * PER_UNIT[axis]
    camera = cameras[np.random.default_rng(case.seed).integers(len(cameras))]
    if case.level == "camera":
        return camera, axis, size * PER_UNIT[axis]
    if (case.data, camera) not in stated:
        raise CalibrationError(f"no detectable change is stated of {camera} in {case.data}")
    return camera, axis, size * float(stated[case.data, camera][axis])


def deployed(now: Rig, of: str, twist: Array) -> Rig:
    """The deployed rig: T_deployed_now = exp(twist) for one camera of ``now``, or for its LiDAR."""
    T = now.T_camera_lidar
    if of == LIDAR:
        T_now_deployed = gtsam.Pose3.Expmap(-twist).matrix()
        return now.moved_to({name: T[name] @ T_now_deployed for name in T})
    return now.moved_to({of: gtsam.Pose3.Expmap(twist).matrix() @ T[of]})


def stated_by(records: list[Record]) -> Iterator[tuple[tuple[str, str], Array]]:
    """The smallest detectable changes that the audits of right rigs state."""
    for record in records:
        if record["kind"] in ("reference", "truth"):
            for name, camera in record.get("cameras", {}).items():
                if camera["trusted"]:
                    both = [*camera["detectable_deg"], *camera["detectable_cm"]]
                    yield (record["data"], name), np.array(both) * PER_UNIT


def to_record(audit: Audit) -> Record:
    """Per camera what was found, and what is WRONG."""
    rate = FALSE_ALARM_RATE / len(audit.cameras)
    return {
        "wrong": list(audit.wrong),
        "cameras": {name: _camera(camera, rate) for name, camera in audit.cameras.items()},
        "motion": None if audit.lidar is None else by_unit("motion", audit.lidar.deviation),
    }


def _camera(camera: CameraAudit, rate: float) -> Record:
    """What an audit states of a camera, with the limits of a significant deviation.

    Args:
        camera: its audit.
        rate: probability of a significant deviation by chance.
    """
    found = {"status": camera.status, "reason": camera.reason, "trusted": _is_trusted(camera)}
    if camera.deviation is None or camera.sigma is None or camera.detectable is None:
        return found
    limit = Limits.of(np.inf, rate, np.ones(2)).axis * camera.sigma
    return {
        **found,
        "significant": (np.abs(camera.deviation) > limit).tolist(),
        **by_unit("deviation", camera.deviation),
        **by_unit("sigma", camera.sigma),
        **by_unit("limit", limit),
        **by_unit("detectable", camera.detectable),
    }


def _is_trusted(camera: CameraAudit) -> bool:
    """Whether the status is by the axes: with a doubt, CANNOT TELL has that for its reason."""
    by_axes = camera.reason.startswith("may be beyond the tolerance")
    return camera.sigma is not None and (camera.status != "CANNOT TELL" or by_axes)


STATUSES = ("OK", "CANNOT TELL", "WRONG")


def report(records: Sequence[Record]) -> list[Table]:
    """All tables."""
    done = [record for record in records if "cameras" in record]
    right, camera, lidar, multiple = (
        [record for record in done if record["level"] == level]
        for level in ("right", "camera", LIDAR, "detectable")
    )
    times = by_size_of_axis(multiple)
    columns = ("axis", "displaced by", "measured", "significant", "expected by the error bar")
    title = "One camera displaced by multiples of the stated smallest detectable change"
    return [
        nothing_displaced(right), by_size("One camera displaced", camera, _own),
        Table(f"{title} (at 1: stated {POWER:.0%})", columns, tuple(times)),
        by_size("The LiDAR displaced", lidar, _all),
    ]  # fmt: skip


def _all(record: Record) -> list[Record]:
    return [*record["cameras"].values()]


def _own(record: Record) -> list[Record]:
    return [record["cameras"][record["of"]]]


def _trusted(cameras: Sequence[Record]) -> list[Record]:
    return [camera for camera in cameras if camera["trusted"]]


def _both(camera: Record, name: str) -> Array:
    """(6,) a quantity in degrees and centimetres."""
    return np.array([*camera[f"{name}_deg"], *camera[f"{name}_cm"]])


def nothing_displaced(records: Sequence[Record]) -> Table:
    """A row per kind of what is deployed: alarms, and deviations beside their sigmas."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record["kind"].split(" of ")[0], []).append(record)
    rows = []
    for group, own in sorted(groups.items()):
        cameras = [camera for record in own for camera in _all(record)]
        rigs = [trusted for record in own if (trusted := _trusted(_all(record)))]
        trusted = _trusted(cameras)
        alarmed = sum(any(sum(c["significant"]) for c in rig) for rig in rigs)
        axes = sum(sum(camera["significant"]) for camera in trusted)
        ratios = [_both(c, "deviation") / _both(c, "sigma") for c in trusted] or [np.nan]
        rows.append((
            group, str(len(own)), str(len(rigs)), str(alarmed), str(len(trusted)),
            f"{axes} of {6 * len(trusted)}", f"{np.sqrt(np.mean(np.square(ratios))):.2f}",
            f"{np.max(np.abs(ratios)):.2f}",
            *(str(sum(c["status"] == status for c in cameras)) for status in STATUSES),
        ))  # fmt: skip
    columns = (
        "what is deployed", "rigs", "measured", "with a significant axis", "cameras measured",
        "significant axes", "deviation over sigma, rms", "largest",
        *(f"cameras {status}" for status in STATUSES),
    )  # fmt: skip
    stated = f"stated: {FALSE_ALARM_RATE:.1%} of rigs have a significant axis"
    return Table(f"Nothing displaced ({stated})", columns, tuple(rows))


def by_size(
    title: str, records: Sequence[Record], moved: Callable[[Record], list[Record]]
) -> Table:
    """A row per size of a displacement; ``moved``: which cameras of an audit moved."""
    rows = []
    for unit, axes in (("deg", range(3)), ("cm", range(3, 6))):
        of_unit = [record for record in records if record["axis"] in axes]
        for size in sorted({abs(round(record["size"], 6)) for record in of_unit}):
            own = [record for record in of_unit if abs(abs(record["size"]) - size) < 1e-6]
            rows.append((f"{size:g} {unit}", *_row_of_size(own, moved)))
    columns = (
        "displaced by", "audits", "measured", "an axis significant", "WRONG", "culprit alone named",
        "CANNOT TELL", "OK", "others OK", "others WRONG",
    )  # fmt: skip
    return Table(title, columns, tuple(rows))


def _row_of_size(own: Sequence[Record], moved: Callable[[Record], list[Record]]) -> tuple[str, ...]:
    """The worst status counts of the cameras that moved."""
    measured = [record for record in own if len(_trusted(moved(record))) == len(moved(record))]
    significant = sum(any(sum(c["significant"]) for c in moved(record)) for record in measured)
    worst = [max((c["status"] for c in moved(record)), key=STATUSES.index) for record in own]
    others = [camera for record in own for name, camera in record["cameras"].items()
              if moved is _own and name != record["of"]]  # fmt: skip
    named = sum(record["wrong"] == [record["of"]] for record in own)
    return (
        str(len(own)), str(len(measured)), str(significant), str(worst.count("WRONG")), str(named),
        str(worst.count("CANNOT TELL")), str(worst.count("OK")),
        *(f"{sum(c['status'] == status for c in others)} of {len(others)}" if others else ""
          for status in ("OK", "WRONG")),
    )  # fmt: skip


def by_size_of_axis(records: Sequence[Record]) -> Iterator[tuple[str, ...]]:
    """Per axis and multiple: how often the displaced axis is significant, and is expected to be."""
    groups = [(name, (axis,)) for axis, name in enumerate(CAMERA_AXES)]
    for name, axes in (*groups, ("all rotations", range(3)), ("all positions", range(3, 6))):
        for times in TIMES:
            cameras = [
                (record["axis"], abs(record["size"]), camera)
                for record in records
                if record["axis"] in axes and abs(float(record["kind"].split(":")[1])) == times
                for camera in _trusted(_own(record))
            ]
            chances = []
            for axis, moved, camera in cameras:
                limit, sigma = (_both(camera, of)[axis] for of in ("limit", "sigma"))
                chances.append(ndtr((moved - limit) / sigma) + ndtr((-moved - limit) / sigma))
            found = sum(camera["significant"][axis] for axis, _, camera in cameras)
            expected = f"{np.mean(chances):.0%}" if chances else ""
            yield name, f"{times:g}", str(len(cameras)), str(found), expected


if __name__ == "__main__":
    main()
