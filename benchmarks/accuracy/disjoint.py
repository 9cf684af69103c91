"""How far results of disjoint frames of one rig are apart, beside their error bars.

    python -m benchmarks.accuracy.disjoint --halves kitti_places,05+06+07+08 --draws 6
    python -m benchmarks.accuracy.disjoint --halves "" --pairs 05/06,05/07,06/07

``--halves``: two random halves of a recording's frames, drawn ``--draws`` times. ``--pairs``: two
recordings of one rig. No reference takes part, so that its own error does not count. Halves of few
places share them, with the errors of a place: their difference is smaller than two recordings'.
What all places share is in both error bars and in no difference, so that 1 is an upper limit. So
each result's table is solved again with nothing stated of what all places share: the sum of those
covariances is of how results repeat, and its squared error should be 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import Folders
from benchmarks.tables import Table
from calibgraph import Calibration, calibrate, perturb
from calibgraph.model.geometry import pose_rows, twist_between
from calibgraph.solver.joint import solve_joint

Array = NDArray[np.float64]

START_DEG, START_M = 5.0, 0.3
HALVES, PAIRS = "halves", "recordings"
SHARED = {
    "systematic_rotation_rad": 1e-6, "systematic_translation_m": 1e-6, "elevation_rad": 0.0,
    "elevation_stretch": 0.0, "scan_motion_m": 0.0,
}  # fmt: skip
"""What a table states of errors that all its places share: next to nothing."""
WITHIN_95 = float(chi2.ppf(0.95, 6)) / 6
ALL = "all"


Estimate = tuple[Array, Array, str, Array]
"""Of a camera: (4, 4) T_camera_lidar; (6, 6) its covariance, rotation [rad] and translation [m] in
the camera's axes; its verdict; and the covariance without what all places share."""


def main() -> None:
    """Run cases, print the table."""
    names: Callable[[str], list[str]] = lambda text: [*filter(None, text.split(","))]  # noqa: E731
    parser = ledger.case_parser(__doc__, "disjoint")
    parser.add_argument("--halves", type=names, default=["kitti_places", "00", "05+06+07+08"])
    parser.add_argument("--pairs", type=names, default=["05/06", "05/07", "06/08", "07/08"])
    parser.add_argument("--draws", type=int, default=6, help="of halves")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    options = parser.parse_args()
    halves = [
        Key(HALVES, "random", name, seed)
        for seed in range(options.first, options.first + options.draws)
        for name in options.halves
    ]
    pairs = [Key(PAIRS, "each", pair, options.first) for pair in options.pairs]
    work = partial(run_case, folders=Folders(options.realdata, None))
    records = ledger.records_of(options, [*halves, *pairs], work)
    ledger.publish_cases([report(records)], records)


def run_case(case: Key, folders: Folders) -> Record:
    """The differences of all cameras that both parts have."""
    if case.level == HALVES:
        count = len(folders.load(case.data)[0].frames)
        parts = [(case.data, tuple(rows)) for rows in split(count, case.seed)]
    else:
        parts = [(name, None) for name in case.data.split("/")]
    first, second = (calibrated(folders, name, case.seed, rows) for name, rows in parts)
    both = [name for name in first if name in second]
    return {"cameras": {name: difference(first[name], second[name]) for name in both}}


@cache  # a recording is in several pairs
def calibrated(
    folders: Folders, name: str, seed: int, rows: tuple[int, ...] | None
) -> dict[str, Estimate]:
    """The results of some frames, or of all."""
    data, truth = folders.load(name)
    frames = [data.frames[i] for i in (range(len(data.frames)) if rows is None else rows)]
    guess = perturb(truth, rotation_deg=START_DEG, translation_m=START_M, seed=seed, uniform=True)
    return estimates(calibrate(data.only(frames), guess))


def estimates(result: Calibration) -> dict[str, Estimate]:
    """The cameras that have an error bar."""
    repeats = repeat_covariances(result)
    return {
        name: (T, covariance, result.camera_verdicts[name].status, repeats[name])
        for name, T in result.T_camera_lidar.items()
        if (covariance := result.covariance.get(name)) is not None
    }


def repeat_covariances(result: Calibration) -> dict[str, Array]:
    """Per camera, (6, 6) of a solve of the result's table without what all places share."""
    table = result.correspondences
    assert table is not None
    unshared = replace(table, metadata={**table.metadata, **SHARED})
    solved = solve_joint(result.rig, unshared, result.config, camera_matches=result.camera_matches)
    assert solved.covariance is not None
    return {
        name: solved.covariance[pose_rows(place), pose_rows(place)]
        for place, name in enumerate(solved.T_camera_lidar)
    }


def split(count: int, seed: int) -> tuple[list[int], list[int]]:
    """Two random halves of ``count`` frames, each in order; the second has the odd one."""
    order = np.random.default_rng(seed).permutation(count)
    return sorted(order[: count // 2].tolist()), sorted(order[count // 2 :].tolist())


def difference(first: Estimate, second: Estimate) -> Record:
    """The difference of two results: its size, and its square in the sum of their covariances."""
    xi = twist_between(first[0], second[0])
    squared, repeated = (
        float(xi @ np.linalg.solve(first[which] + second[which], xi)) / 6 for which in (1, 3)
    )
    return {
        "difference_deg": float(np.degrees(np.linalg.norm(xi[:3]))),
        "difference_cm": float(100 * np.linalg.norm(xi[3:])),
        "normalised_squared": squared,
        "repeated_squared": repeated,
        "statuses": [first[2], second[2]],
    }


COLUMNS = (
    "data", "cameras", "median [deg]", "[cm]", "largest [deg]", "[cm]",
    "squared in its covariance, over 6", "in the 95 % region", "both PASS",
    "without what all share", "of these in the 95 % region",
)  # fmt: skip


def report(records: Sequence[Record]) -> Table:
    """A row per recording or pair of recordings, and one of all together."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        for name in (f"{record['level']} of {record['data']}", ALL):
            groups.setdefault(name, []).extend(record.get("cameras", {}).values())
    last = {ALL: groups.pop(ALL, [])}
    rows = [_cells(name, found) for name, found in {**groups, **last}.items() if found]
    return Table("Differences of results of disjoint frames", COLUMNS, tuple(rows))


def _cells(name: str, found: Sequence[Record]) -> tuple[str, ...]:
    size = np.array([[c["difference_deg"], c["difference_cm"]] for c in found])
    squared, repeated = (
        np.array([c[f"{which}_squared"] for c in found]) for which in ("normalised", "repeated")
    )
    passed = sum(c["statuses"] == ["PASS", "PASS"] for c in found)
    return (
        name, str(len(found)), *(f"{v:.2f}" for v in np.median(size, axis=0)),
        *(f"{v:.2f}" for v in size.max(axis=0)), f"{squared.mean():.2f}",
        f"{np.mean(squared <= WITHIN_95):.0%}", str(passed),
        f"{repeated.mean():.2f}", f"{np.mean(repeated <= WITHIN_95):.0%}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
