"""Verdicts of several LiDARs on drawn vehicles, and what ``check`` finds of one that has moved.

    python -m benchmarks.accuracy.vehicles --cases 0:50 --jobs 16
    python -m benchmarks.accuracy.vehicles --moved --cases 0:40 --beams 32 --rays 900

A vehicle has two or three LiDARs at random headings, tilted by up to 40 degrees, a seventh of them
upside down, at three to five places of a town, a street, a room or a corridor. Clouds of a place
are displaced by up to 1.5 times the prior of what places differ by; two of five LiDARs have a guess
20 degrees and 0.5 m off. Off is more than 0.5 degrees or 10 cm.

With ``--moved`` a vehicle of three LiDARs is recorded twice at ten places of towns, displaced by
0.03 degrees and 0.45 cm; in between nothing moves, or one LiDAR or the base by 0.2 degrees or 2 cm.
"""

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import ledger
from benchmarks.accuracy.cases import random_transform
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.verdicts import class_of
from benchmarks.tables import Table
from calibgraph import CalibrationError, calibrate, check
from calibgraph.model.geometry import invert, transform
from calibgraph.vehicle.lidars import PLACE_SIGMAS
from tests.vehicle.scenes import HEIGHT_M, MOUNTS, draw_place, flat_street, scan

Array = NDArray[np.float64]
Clouds = Mapping[str, Sequence[Array]]

PLACES = ("town", "street", "room", "corridor")
SCATTER = np.repeat([np.radians(0.03), 0.0045], 3)
"""(6,) [rad, m] of the clouds of ``--moved``."""
MOVES = ("nothing", "turned", "shifted", "base turned", "base shifted")
_TURN_DEG, _SHIFT_M = 0.2, 0.02
_TOLERANCE = {"tolerance_deg": 0.1, "tolerance_cm": 1.0}


def main() -> None:
    """Draw, calibrate or check, keep a line of each."""
    parser = ledger.case_parser(__doc__, "vehicles")
    add = parser.add_argument
    add("--cases", default="0:4", help="first and last seed, the last left out")
    add("--moved", action="store_true", help="compare two recordings of each vehicle")
    add("--beams", type=int, default=16)
    add("--rays", type=int, default=180, help="of a beam, all around")
    arguments = parser.parse_args()
    seeds, scans = (
        range(*map(int, arguments.cases.split(":"))),
        f"{arguments.beams} x {arguments.rays}",
    )
    kinds, level = (MOVES, "moved") if arguments.moved else (PLACES, "drawn")
    cases = [Key(level, kinds[seed % len(kinds)], scans, seed) for seed in seeds]
    work = partial(_moved if arguments.moved else _drawn, beams=arguments.beams,
                   rays=arguments.rays)  # fmt: skip
    records = ledger.records_of(arguments, cases, work)
    ledger.publish_cases([report(records)], records)


def _drawn(case: Key, beams: int, rays: int) -> Record:
    """The verdicts and errors of a vehicle's LiDARs."""
    rng = np.random.default_rng([5, case.seed])
    mounts = {"base": transform(np.eye(3))}
    for number in range(rng.integers(1, 3)):
        angles = rng.uniform([-180.0, -40.0, -5.0], [180.0, 40.0, 5.0])
        angles[2] += 180.0 * (rng.random() < 1 / 7)
        turn = Rotation.from_euler("zyx", angles, degrees=True)
        mounts[f"lidar{number}"] = transform(turn, rng.uniform([-2, -1, -1], [2, 1, 0.2]))
    scatter, guess = rng.uniform(0.0, 1.5) * PLACE_SIGMAS, {}
    for name, T in mounts.items():
        if name != "base" and rng.random() < 0.4:  # noqa: PLR2004
            guess[name] = T @ random_transform(rng, 20.0, 0.5)
    clouds = _record(case.kind, mounts, scatter, int(rng.integers(3, 6)), rng, (beams, rays))
    with tempfile.TemporaryDirectory() as folder:
        try:
            result = calibrate(_write(Path(folder), clouds, guess))
        except CalibrationError as error:
            return {"refused": str(error)}
    return {
        "lidars": {
            name: _errors(result.T_base_lidar[name], mounts[name])
            | {"status": result.verdicts[name].status}
            for name in guess.keys() | mounts.keys() - {"base"}
        }
    }


def _moved(case: Key, beams: int, rays: int) -> Record:
    """The sensors that ``check`` names, after one has moved or none."""
    rng, after = np.random.default_rng([6, case.seed]), dict(MOUNTS)
    lidar = "front" if case.seed % 2 else "left"
    deg = _TURN_DEG * case.kind.endswith("turned")
    step = random_transform(rng, deg, _SHIFT_M * case.kind.endswith("shifted"))
    if case.kind.startswith("base"):
        after = {name: T if name == "top" else invert(step) @ T for name, T in MOUNTS.items()}
        lidar = "top"
    else:
        after[lidar] = MOUNTS[lidar] @ step
    with tempfile.TemporaryDirectory() as folder:
        first, second = (
            _write(
                Path(folder) / name, _record("town", at, SCATTER, 10, rng, (beams, rays)), MOUNTS
            )
            for name, at in (("first", MOUNTS), ("second", after))
        )
        found = check(calibrate(first).rig, second, **_TOLERANCE)
    return {"named": [*found.wrong], "right": [] if case.kind == "nothing" else [lidar]}


def _record(
    kind: str, mounts: Mapping[str, Array], scatter: Array, places: int, rng: np.random.Generator,
    size: tuple[int, int],
) -> Clouds:  # fmt: skip
    """Clouds of each LiDAR, the first the base, at places of a kind."""
    clouds: dict[str, list[Array]] = {name: [] for name in mounts}
    azimuths_deg = np.linspace(-180.0, 180.0, size[1], endpoint=False)
    boxes = _boxes(kind, rng)
    for _ in range(places):
        boxes = _boxes(kind, rng) if kind == "town" else boxes
        tilt = Rotation.from_euler("zyx", rng.normal(0.0, [5.0, 0.5, 0.5]), degrees=True)
        at = transform(tilt, [rng.uniform(-4, 4), rng.uniform(-0.5, 0.5), HEIGHT_M])
        for number, (name, T) in enumerate(mounts.items()):
            off = np.zeros(6) if number == 0 else rng.normal(0.0, scatter)
            here = at @ transform(Rotation.from_rotvec(off[:3]).as_matrix() @ T[:3, :3],
                                  T[:3, 3] + off[3:])  # fmt: skip
            clouds[name].append(scan(boxes, here, rng, beams=size[0], azimuths_deg=azimuths_deg))
    return clouds


def _boxes(kind: str, rng: np.random.Generator) -> Array:
    """(n, 2, 3) corners."""
    if kind == "town":
        return draw_place(rng)
    if kind == "street":
        return np.concatenate([flat_street(), draw_place(rng, boxes=3, fronts=False)])
    half_m = (15.0, 8.0) if kind == "room" else (20.0, 3.0)
    walls = [[[s * half_m[0] - 0.5, -30, 0], [s * half_m[0] + 0.5, 30, 6]] for s in (-1, 1)]
    walls += [[[-30, s * half_m[1] - 0.5, 0], [30, s * half_m[1] + 0.5, 6]] for s in (-1, 1)]
    inside = draw_place(rng, boxes=int(rng.integers(0, 5)), fronts=False)
    return np.concatenate([np.array(walls, dtype=np.float64), inside])


def _write(folder: Path, clouds: Clouds, guess: Mapping[str, Array]) -> Path:
    """A dataset folder; the first LiDAR is the base."""
    base = next(iter(clouds))
    for name, of in clouds.items():
        (folder / "lidars" / name).mkdir(parents=True)
        for number, cloud in enumerate(of):
            np.save(folder / "lidars" / name / f"{number:03d}", cloud)
    lidars = {
        name: {"T_base_lidar": guess[name].tolist()} if name in guess and name != base else {}
        for name in clouds
    }
    content = {"format": "calibgraph-rig/1", "lidar": base, "lidars": lidars}
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder


def _errors(T: Array, truth: Array) -> Record:
    turn = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).magnitude()
    shift_m = np.linalg.norm(T[:3, 3] - truth[:3, 3])
    return {"error_deg": float(np.degrees(turn)), "error_cm": 100.0 * float(shift_m)}


def report(records: Sequence[Record]) -> Table:
    """LiDARs by verdict and by whether they are off; or vehicles by what is named."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for record in records:
        of = counts.setdefault((record["kind"], record["data"]), Counter())
        of["refused"] += "refused" in record
        for one in record.get("lidars", {}).values():
            is_off = class_of(one) == "off"
            of[f"{one['status']}, {'off' if is_off else 'right'}"] += 1
        if "named" in record:
            of["as it is" if record["named"] == record["right"] else
               "nothing named" if not record["named"] else "another named"] += 1  # fmt: skip
    heads = (
        "PASS, right", "PASS, off", "WARN, right", "WARN, off", "FAIL, right", "FAIL, off",
        "refused", "as it is", "nothing named", "another named",
    )  # fmt: skip
    rows = tuple((*key, *(str(of[head]) for head in heads)) for key, of in sorted(counts.items()))
    return Table("Drawn vehicles", ("case", "scans", *heads), rows)


if __name__ == "__main__":
    main()
