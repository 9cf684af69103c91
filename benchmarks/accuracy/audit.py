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

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from benchmarks.accuracy import ledger
from benchmarks.accuracy.audit_data import ONE_RIG, RECORDINGS, Sources, ring
from benchmarks.accuracy.audit_tables import report
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.tables import ROOT, add_record_option
from calibgraph import Audit, CalibrationError, CameraAudit, Rig, check
from calibgraph.audit.result import by_unit
from calibgraph.audit.significance import tail_of_axis

Array = NDArray[np.float64]

SIZES = {"deg": (0.1, 0.2, 0.5, 1.0, 2.0), "cm": (1.0, 2.0, 5.0, 10.0, 20.0)}
TIMES = (0.5, 0.75, 1.0, 1.25, 1.5)
UNITS = ("deg",) * 3 + ("cm",) * 3
PER_UNIT = np.repeat([np.pi / 180, 0.01], 3)  # rad or m

Stated = Mapping[tuple[str, str], Array]
"""(6,) smallest detectable changes [rad, m] of a camera, by data and camera."""


def main() -> None:
    """Audit what is right, then what is displaced; print the tables."""
    options = parse_options()
    sources = Sources(options.realdata, options.out.with_suffix(""))
    if options.summary is not None:
        records = ledger.read(options.summary)
    else:
        work = partial(run_case, sources=sources, stated={})
        records = ledger.run(right_cases(options.scenes), work, out=options.out, jobs=options.jobs)
        work = partial(run_case, sources=sources, stated=dict(stated_by(records)))
        cases = displaced_cases(ring(), options.repeats)
        records = ledger.run(cases, work, out=options.out, jobs=options.jobs)
    ledger.publish_cases("accuracy.audit", report(records), records, record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=48, help="right ones, a sensor each")
    parser.add_argument("--repeats", type=int, default=3, help="of each axis and size of a camera")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "audit.jsonl")
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run nothing")
    add_record_option(parser)
    return parser.parse_args()


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
        for level, count in (("camera", repeats), ("detectable", 2), ("LiDAR", 2)):
            for axis, step in np.ndindex(6, len(TIMES)) if repeat < count else ():
                size = TIMES[step] if level == "detectable" else SIZES[UNITS[axis]][step]
                sign = 1 - 2 * ((repeat + axis + step) % 2)
                number = len(cases)
                kind = f"{axis}:{sign * size:g}"
                cases.append(Key(level, kind, names[number % len(names)], number))
    return cases


@dataclass(frozen=True)
class Displacement:
    """What is displaced.

    Attributes:
        of: a camera, or ``LiDAR``.
        axis: 0 to 5: about x, y, z, along x, y, z, in its own frame.
        size: [rad or m].
    """

    of: str
    axis: int
    size: float

    @property
    def twist(self) -> Array:
        """(6,) xi in T_deployed_now = exp(xi)."""
        twist = np.zeros(6)
        twist[self.axis] = self.size
        return twist

    def deployed(self, now: Rig) -> Rig:
        """The rig of which ``now`` differs by this displacement."""
        T = now.T_camera_lidar
        if self.of == "LiDAR":
            T_now_deployed = gtsam.Pose3.Expmap(-self.twist).matrix()
            return now.moved_to({name: T[name] @ T_now_deployed for name in T})
        return now.moved_to({self.of: gtsam.Pose3.Expmap(self.twist).matrix() @ T[self.of]})


def run_case(case: Key, sources: Sources, stated: Stated) -> Record:
    """Audit one deployed rig."""
    data, truth = sources.load(case.data)
    if case.level == "right":
        return to_record(check(right_rig(case.kind, truth, sources), data))
    moved = displacement(case, list(truth.cameras), stated)
    audit = check(moved.deployed(truth), data)
    size = moved.size / PER_UNIT[moved.axis]
    return {"of": moved.of, "axis": moved.axis, "size": size, **to_record(audit)}


def right_rig(kind: str, truth: Rig, sources: Sources) -> Rig:
    """The truth or reference, or the result of another recording."""
    of = kind.removeprefix("result of ")
    return truth if of == kind else sources.result(of)


def displacement(case: Key, cameras: list[str], stated: Stated) -> Displacement:
    """The displacement of a case; its camera is drawn by the case's number.

    Raises:
        CalibrationError: if the audit of the right rig states no smallest detectable change.
    """
    axis, size = int(case.kind.split(":")[0]), float(case.kind.split(":")[1])
    if case.level == "LiDAR":
        return Displacement("LiDAR", axis, size * PER_UNIT[axis])
    camera = cameras[np.random.default_rng(case.seed).integers(len(cameras))]
    if case.level == "camera":
        return Displacement(camera, axis, size * PER_UNIT[axis])
    if (case.data, camera) not in stated:
        raise CalibrationError(f"no detectable change is stated of {camera} in {case.data}")
    return Displacement(camera, axis, size * float(stated[case.data, camera][axis]))


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
    tail = tail_of_axis(len(audit.cameras))
    return {
        "wrong": list(audit.wrong),
        "cameras": {name: _camera(camera, tail) for name, camera in audit.cameras.items()},
        "motion": None if audit.lidar is None else by_unit("motion", audit.lidar.motion),
    }


def _camera(camera: CameraAudit, tail: float) -> Record:
    """What an audit states of a camera, with the limits of a significant deviation.

    Args:
        camera: its audit.
        tail: probability of a larger deviation by chance, to either side.
    """
    found = {"status": camera.status, "reason": camera.reason, "trusted": _is_trusted(camera)}
    if camera.deviation is None or camera.sigma is None or camera.detectable is None:
        return found
    limit = float(-ndtri(tail)) * camera.sigma
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


if __name__ == "__main__":
    main()
