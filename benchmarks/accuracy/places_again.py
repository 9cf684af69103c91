"""Whether places that are visited again are recognised by their clouds, and no others are.

    python -m benchmarks.accuracy.places_again [--streets 4] [--stops 12] [--beams 64] [--alike]

Stops of rendered streets, some 6 m apart; at every third the vehicle drives the other way, in the
other lane. All pairs of clouds are compared, those of one street by how far apart they are, and
those of different streets.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import Table, add_record_option, publish
from calibgraph.matching.cloud_similarity import UprightCloud, align_with_any
from calibgraph.matching.places import PLACE_M
from calibgraph.model.geometry import invert
from calibgraph.simulation.lidar import lidar_of, ring_gains, scan
from calibgraph.simulation.recording import build_drive

Array = NDArray[np.float64]

FIRST_SEED, STEP_M, OTHER_LANE_M = 21, 6.0, 3.5
EDGES_M = (0, 7, 10, 15, 20, 25, 30, 40, 1000)
WRONG_M = 2.0
COLUMNS = (
    "clouds", "pairs", "aligned", f"of these off by over {WRONG_M:g} m", "of one place",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Stop:
    """A cloud, and where it was taken."""

    street: int
    T_world_lidar: Array
    cloud: UprightCloud


@dataclass(frozen=True)
class Pair:
    """Two clouds.

    Attributes:
        group: by how they lie to each other.
        found_m: how far apart they are found to be; NaN where they are not aligned.
        off_m: error of the motion between them; NaN where nothing is known of it.
    """

    group: str
    found_m: float
    off_m: float


def main() -> None:
    """Scan, compare, and print one table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--streets", type=int, default=4)
    parser.add_argument("--stops", type=int, default=12)
    parser.add_argument("--beams", type=int, default=64)
    parser.add_argument("--alike", action="store_true", help="streets of one layout")
    add_record_option(parser)
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.streets)
    stops = [s for seed in seeds for s in stops_of(seed, options.stops, options.beams,
                                                   vary_layout=not options.alike)]  # fmt: skip
    pairs = [compare(*both) for both in combinations(stops, 2)]
    groups = sorted({pair.group for pair in pairs}, key=_order)
    rows = tuple(_row(group, [pair for pair in pairs if pair.group == group]) for group in groups)
    layout = "of one layout" if options.alike else "that differ"
    title = f"{options.streets} streets {layout}, {options.beams} beams"
    publish("accuracy.places_again", [Table(title, COLUMNS, rows)], record=options.record)


def stops_of(seed: int, count: int, beams: int, *, vary_layout: bool) -> Iterator[Stop]:
    """The stops of one street."""
    drive = build_drive(frames=count, step_m=STEP_M, seed=seed, vary_layout=vary_layout)
    lidar = lidar_of(beams)
    gains = ring_gains(lidar, np.random.default_rng(seed))
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    back[1, 3] = OTHER_LANE_M
    for number, T in enumerate(drive.T_world_lidar):
        pose = T @ back if number % 3 == 2 else T  # noqa: PLR2004
        cloud = scan(drive.world, lidar, gains, pose, rng=np.random.default_rng([seed, number]))
        yield Stop(seed, pose, UprightCloud.from_cloud(cloud))


def compare(one: Stop, other: Stop) -> Pair:
    """How two stops are found to lie to each other."""
    found = align_with_any(other.cloud, [one.cloud])
    found_m = np.full(3, np.nan) if found is None else found[1][:3, 3]
    if one.street != other.street:
        return Pair("different streets", float(np.linalg.norm(found_m)), np.nan)
    T_other_one = invert(other.T_world_lidar) @ one.T_world_lidar
    apart_m = float(np.linalg.norm(T_other_one[:3, 3]))
    least = max(edge for edge in EDGES_M if edge <= apart_m)
    most = min(edge for edge in EDGES_M if edge > apart_m)
    way = "the same way" if T_other_one[0, 0] > 0 else "the other way"
    far = f"over {least} m apart" if most == EDGES_M[-1] else f"{least} to {most} m apart"
    off_m = float(np.linalg.norm(found_m - T_other_one[:3, 3]))
    return Pair(f"{far}, {way}", float(np.linalg.norm(found_m)), off_m)


def _row(group: str, pairs: list[Pair]) -> tuple[str, ...]:
    aligned = sum(pair.found_m >= 0 for pair in pairs)
    wrong = sum(pair.off_m > WRONG_M for pair in pairs)
    merged = sum(pair.found_m <= PLACE_M for pair in pairs)
    known = "" if "streets" in group else str(wrong)
    return group, str(len(pairs)), str(aligned), known, str(merged)


def _order(group: str) -> tuple[float, str]:
    first = group.removeprefix("over ").split()[0]
    return (float(first) if first.isdigit() else np.inf), group


if __name__ == "__main__":
    main()
