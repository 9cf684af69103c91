"""Lenses and clocks that are wrong, before and after they are estimated with the extrinsics.

    python -m benchmarks.accuracy.lens [--draws 30] [--parts focal lens offset ...]

Simulated tables of two cameras like KITTI's, 30 frames of 100 matches, with errors that the matches
of a frame share. Clocks: images that are later than their clouds, of a LiDAR on a car in town, 2 to
15 m/s with turns of 0.2 rad/s. NEES is the squared error of a camera's pose in the metric of its
covariance; its mean over 6 should be 1. ``z^2`` is the mean square of the errors of lens or clock
in their sigmas. Recordings: ``benchmarks.accuracy.lens_cases``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.uncertainty import ERRORS
from benchmarks.tables import Table, parser_of, publish
from calibgraph import Camera, Config, Correspondences, Rig, simulate_correspondences
from calibgraph.graph.lens import LensVariable
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from factors import Clock
from factors.columns import COEFFICIENT_NUMBERS
from tests.draws.clocks import draw_twists, put_clock_error
from tests.draws.lenses import put_lens_error

Array = NDArray[np.float64]
Drawn = tuple[list[Array], list[Array], list[float], list[tuple[float, float]]]
"""Per camera (6,) error of the pose before, and after, and its NEES; of what was spoilt the error
of the estimate, with its sigma."""

FRAMES, MATCHES = 30, 100
CASES: tuple[tuple[str, float | Clock], ...] = (
    ("focal", 0.0), ("focal", 0.003), ("focal", 0.017), ("focal", 0.05),
    ("centre", 3.0), ("centre", 10.0), ("centre", 30.0),
    ("distortion", 0.01), ("distortion", 0.03), ("distortion", 0.1),
    ("lens", 0.0),
    *(("offset", Clock(offset_s, 0.0)) for offset_s in (0.0, 0.005, 0.02, 0.1)),
    ("readout", Clock(0.0, 0.03)), ("clock", Clock(0.02, 0.03)), ("lens,clock", Clock(0.02, 0.03)),
)  # fmt: skip
"""Part that is estimated; its error: of the focal length (share), of cx [px], of k1, or the clock
of the images; the whole lens is drawn from its prior."""

COLUMNS = (
    "part", "error", "before [deg]", "[cm]", "after [deg]", "[cm]", "NEES / 6", "off", "sigma",
    "z^2",
)  # fmt: skip


def main() -> None:
    """Draw, solve, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=30)
    parts = sorted({part for part, _ in CASES})
    parser.add_argument("--parts", nargs="+", default=parts, choices=parts)
    options = parser.parse_args()
    rows = []
    for part, error in CASES:
        if part in options.parts:
            drawn = [draw(part, error, seed) for seed in range(options.draws)]
            rows.append((part, _text(error), *cells_of(drawn)))
    title = f"{options.draws} draws, medians of 2 cameras; times in seconds"
    publish([Table(title, COLUMNS, tuple(rows))])


def _text(error: float | Clock) -> str:
    if isinstance(error, Clock):
        return f"{1e3 * error.offset_s:g}, {1e3 * error.readout_s:g} ms"
    return f"{error:g}"


@cache
def simulated(seed: int) -> tuple[Rig, Correspondences]:
    """The true rig, and its matches."""
    rig = rig_of("kitti")
    return rig, simulate_correspondences(
        rig, frames=FRAMES, matches=MATCHES, errors=ERRORS, seed=seed
    )


def draw(part: str, error: float | Clock, seed: int) -> Drawn:
    """Solve a table with a wrong lens, or of late images, without and with the estimate."""
    (truth, table), config = simulated(seed), Config(estimate=part)
    wrong, times = truth, dict[str, float]()
    if isinstance(error, Clock):
        twists = draw_twists(int(table.frame.max()) + 1, np.random.default_rng([seed, 1]))
        table = put_clock_error(table, truth, twists, error)
        times = {"offset": error.offset_s, "readout": error.readout_s}
    elif part == "lens":
        rng = np.random.default_rng(seed)
        free = {n: LensVariable.of(c, config.estimate) for n, c in truth.cameras.items()}
        cameras = {
            name: lens.put_into(lens.camera, rng.standard_normal(len(lens.free)))
            for name, lens in free.items()
        }
        wrong = truth.model_copy(update={"cameras": cameras})
    else:
        wrong = put_lens_error(truth, part, error)  # type: ignore[arg-type]
    before, after = (solve_joint(wrong, table, one) for one in (Config(), config))
    errors = [_errors(each.T_camera_lidar, truth) for each in (before, after)]
    covariance = after.covariance
    assert covariance is not None
    nees = [
        float(xi @ np.linalg.solve(covariance[6 * n : 6 * n + 6, 6 * n : 6 * n + 6], xi))
        for n, xi in enumerate(errors[1])
    ]
    off = [
        (one.value - right[one.name], one.sigma)
        for name, found in after.lens.items()
        for right in [times or values_of(truth.cameras[name])]
        for one in (found if times or part == "lens" else found[:1]) if one.name in right
    ]  # fmt: skip
    return errors[0], errors[1], nees, off


def _errors(T: dict[str, Array], truth: Rig) -> list[Array]:
    return [twist_between(T[name], truth.T_camera_lidar[name]) for name in T]


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


def cells_of(found: Sequence[Drawn]) -> tuple[str, ...]:
    """Of all draws: errors before and after, NEES, and how far the estimates are off."""
    cells = []
    for when in (0, 1):
        errors = np.array([xi for one in found for xi in one[when]])
        turned, moved = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).T
        cells += [f"{np.degrees(np.median(turned)):.3f}", f"{100 * np.median(moved):.2f}"]
    nees = np.mean([value for one in found for value in one[2]]) / 6
    off, sigmas = np.array([pair for one in found for pair in one[3]]).T
    of_part = (np.median(np.abs(off)), np.median(sigmas), np.mean((off / sigmas) ** 2))
    return (*cells, f"{nees:.2f}", *(f"{value:.2g}" for value in of_part))


if __name__ == "__main__":
    main()
