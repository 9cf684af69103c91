"""Lenses that are wrong, before and after they are estimated with the extrinsics.

    python -m benchmarks.accuracy.lens [--draws 30]

Simulated tables of two cameras like KITTI's, 30 frames of 100 matches, with errors that the matches
of a frame share. NEES is the squared error of a camera's pose in the metric of its covariance; its
mean over 6 should be 1. ``z^2`` is the mean square of the lens' errors in their sigmas. Recordings:
``benchmarks.accuracy.lens_cases``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import Table, parser_of, publish
from calibgraph import Camera, Config, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.graph.lens import LensVariable
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from factors.free_lens import COEFFICIENT_NUMBERS
from tests.draws.lenses import put_lens_error

Array = NDArray[np.float64]

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
CASES = (
    ("focal", 0.0), ("focal", 0.003), ("focal", 0.017), ("focal", 0.05),
    ("centre", 3.0), ("centre", 10.0), ("centre", 30.0),
    ("distortion", 0.01), ("distortion", 0.03), ("distortion", 0.1),
    ("lens", 0.0),
)  # fmt: skip
"""Part that is estimated; its error: of the focal length (share), of cx [px], of k1."""

COLUMNS = (
    "part", "error", "before [deg]", "[cm]", "after [deg]", "[cm]", "NEES / 6", "lens off",
    "sigma", "z^2",
)  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """One solve with a wrong lens.

    Attributes:
        before: per camera (6,) error of the pose with the wrong lens.
        after: the same with the estimated lens.
        nees: per camera, of ``after``.
        off: per camera and parameter that was spoilt, error of the estimate.
        sigmas: of these.
    """

    before: list[Array]
    after: list[Array]
    nees: list[float]
    off: list[float]
    sigmas: list[float]


@cache
def simulated(seed: int, frames: int = 30, matches: int = 100) -> tuple[Rig, Correspondences]:
    """The true rig, and its matches."""
    rig = rig_of("kitti")
    return rig, simulate_correspondences(
        rig, frames=frames, matches=matches, errors=ERRORS, seed=seed
    )


def draw(part: str, error: float, seed: int) -> Drawn:
    """Solve a table with a wrong lens; of ``lens``, all of it is drawn from its prior."""
    truth, table = simulated(seed)
    config = Config(estimate=part)
    wrong = put_lens_error(truth, part, error)
    if part == "lens":
        rng = np.random.default_rng(seed)
        free = {n: LensVariable.of(c, config.estimate) for n, c in truth.cameras.items()}
        cameras = {
            name: lens.put_into(lens.camera, rng.standard_normal(len(lens.free)))
            for name, lens in free.items()
        }
        wrong = truth.model_copy(update={"cameras": cameras})
    before, after = (solve_joint(wrong, table, one) for one in (Config(), config))
    errors = errors_of(after, truth)
    off, sigmas = zip(*_lens_errors(after, truth, part), strict=True)
    return Drawn(errors_of(before, truth), errors, nees_of(after, errors), [*off], [*sigmas])


def errors_of(found: Solution, truth: Rig) -> list[Array]:
    """(6,) per camera, of its pose."""
    reference = truth.T_camera_lidar
    return [twist_between(T, reference[name]) for name, T in found.T_camera_lidar.items()]


def nees_of(found: Solution, errors: list[Array]) -> list[float]:
    """Per camera, the squared error in the metric of its covariance."""
    assert found.covariance is not None
    blocks = (found.covariance[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] for n in range(len(errors)))
    return [float(e @ np.linalg.solve(own, e)) for e, own in zip(errors, blocks, strict=True)]


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


def _lens_errors(found: Solution, truth: Rig, part: str) -> Iterator[tuple[float, float]]:
    """Error and sigma of the parameter that was spoilt, of all with ``lens``."""
    for name, parameters in found.lens.items():
        right = values_of(truth.cameras[name])
        for one in parameters[: None if part == "lens" else 1]:
            yield one.value - right[one.name], one.sigma


def main() -> None:
    """Draw, solve, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=30)
    options = parser.parse_args()
    seeds = range(options.draws)
    rows = tuple((part, f"{error:g}", *cells_of([draw(part, error, seed) for seed in seeds]))
                 for part, error in CASES)  # fmt: skip
    table = Table(f"{options.draws} draws, medians of 2 cameras", COLUMNS, rows)
    publish("accuracy.lens", [table], record=options.record)


def cells_of(found: list[Drawn]) -> tuple[str, ...]:
    """Of all draws: errors before and after, NEES, and how far the estimates are off."""
    cells = [cell for when in ("before", "after") for cell in sizes_of(found, when)]
    nees = np.mean([value for one in found for value in one.nees]) / 6
    off, sigmas = (
        np.concatenate([getattr(one, key) for one in found]) for key in ("off", "sigmas")
    )
    lens = (np.median(np.abs(off)), np.median(sigmas), np.mean((off / sigmas) ** 2))
    return (*cells, f"{nees:.2f}", *(f"{value:.2g}" for value in lens))


def sizes_of(found: list[Drawn], when: str) -> tuple[str, str]:
    """Medians over draws and cameras: degrees, centimetres."""
    errors = np.array([error for one in found for error in getattr(one, when)])
    turned, moved = (
        np.median(np.linalg.norm(part, axis=1)) for part in np.split(errors, 2, axis=1)
    )
    return f"{np.degrees(turned):.3f}", f"{100 * moved:.2f}"


if __name__ == "__main__":
    main()
