"""Streets of one sensor, solved together, as they are and changed, and the errors of the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.accuracy.alignment import ALIGNMENT, mean_poses
from calibgraph import (
    Config,
    Correspondences,
    RelativePose,
    Rig,
    load_camera_matches,
    load_correspondences,
    load_rig,
)
from calibgraph.model.camera_matches import CameraMatches, concatenate_camera_matches
from calibgraph.model.correspondences import concatenate
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import relative_covariance, relative_transform, twist_between
from calibgraph.pipeline import to_calibration
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.image_record import RunChecks

FRAMES = 3  # of a street


@dataclass(frozen=True)
class Found:
    """The error of one camera, with its verdict, or of one next to the one before it."""

    of: str
    nees_over_6: float
    degrees: float
    centimetres: float
    status: str = ""


@dataclass(frozen=True)
class Streets:
    """What is solved together.

    Attributes:
        truth: the rig as it is.
        aligned: per camera, the mean of the streets' alignments.
        start: the rig to start from, with relative poses if any are known.
        table: of all streets, with places.
        matches: of pairs of cameras; None without any.
    """

    truth: Rig
    aligned: dict[str, np.ndarray]
    start: Rig
    table: Correspondences
    matches: CameraMatches | None


def load_streets(folders: Sequence[Path]) -> Streets:
    """The tables of some streets of one sensor."""
    truth, tables, pairs, places = load_rig(folders[0] / "reference.yaml"), [], [], []
    for number, folder in enumerate(folders):
        table, add = load_correspondences(folder / "correspondences.parquet"), number * FRAMES
        tables.append(replace(table, frame=table.frame + add))
        places.append(list(range(add, add + FRAMES)))
        if (folder / "camera_matches.parquet").is_file():
            matches = load_camera_matches(folder / "camera_matches.parquet")
            pairs.append(replace(matches, frame=matches.frame + add))
    joined = concatenate(tables)
    stated = asdict(error_components().matchers["structure"])  # also where tables are older
    joined = replace(joined, metadata={**joined.metadata, **stated, "places": places})
    matches = concatenate_camera_matches(pairs) if pairs else None
    aligned = mean_poses([load_rig(folder / ALIGNMENT).T_camera_lidar for folder in folders])
    return Streets(truth, aligned, load_rig(folders[0] / "result.yaml"), joined, matches)


def solve_streets(streets: Streets) -> Iterator[Found]:
    """Of each camera, and of each next to the one before it."""
    truth = streets.truth
    solved = solve_joint(
        streets.start, streets.table, Config(stage1="rig", learnt_weights=False),
        camera_matches=streets.matches,
    )  # fmt: skip
    evidence = Evidence(solved, guess=streets.start)
    checks = RunChecks(assess(evidence), unseen=evidence.cameras)
    verdicts = to_calibration(evidence, checks).camera_verdicts
    statuses = {name: verdict.status for name, verdict in verdicts.items()}
    joint, mount = solved.covariance, solved.marginals.mount
    assert joint is not None and mount.covariance is not None
    errors, T = [], mount.T_camera_lidar
    for place, name in enumerate(T):
        errors.append(twist_between(T[name], truth.cameras[name].T_camera_lidar))
        rows = slice(6 * place, 6 * place + 6)
        error = twist_between(solved.T_camera_lidar[name], streets.aligned[name])
        yield replace(_found("camera", error, joint[rows, rows]), status=statuses[name])
        if place:
            T_b_a = relative_transform(T[name], T[list(T)[place - 1]])
            between = errors[place] - gtsam.Pose3(T_b_a).AdjointMap() @ errors[place - 1]
            of_pair = relative_covariance(mount.covariance, place - 1, place, T_b_a)
            yield _found("pair", between, of_pair)


def _found(of: str, error: np.ndarray, covariance: np.ndarray) -> Found:
    nees = float(error @ np.linalg.solve(covariance, error))
    degrees, metres = (float(np.linalg.norm(part)) for part in (error[:3], error[3:]))
    return Found(of, nees / 6, float(np.degrees(degrees)), 100 * metres)


def without_pairs(streets: Streets, rng: np.random.Generator) -> Streets:
    """What cameras see in common is not used."""
    return replace(streets, matches=None)


def tied(streets: Streets, rng: np.random.Generator) -> Streets:
    """The relative pose of the first two cameras is measured, to 0.02 deg and 0.3 cm."""
    sigmas = {"rotation_sigma_rad": np.radians(0.02), "translation_sigma_m": 0.003}
    a, b = list(streets.truth.cameras)[:2]
    T = streets.truth.T_camera_lidar
    error = np.repeat([*sigmas.values()], 3) * rng.standard_normal(6)
    measured = relative_transform(T[a], T[b]) @ gtsam.Pose3.Expmap(error).matrix()
    pose = RelativePose(a=a, b=b, T_a_b=measured, **sigmas)
    start = streets.start.model_copy(update={"relative_poses": (pose,)})
    return replace(streets, start=start, matches=None)


def few_frames(streets: Streets, rng: np.random.Generator, *, count: int) -> Streets:
    """The first camera has matches in so many frames alone."""
    table, first = streets.table, next(iter(streets.truth.cameras))
    own = table.camera_index == table.cameras.index(first)
    kept = table.select(~own | (table.frame < count))
    return replace(streets, table=kept, matches=None)


def repeated(streets: Streets, rng: np.random.Generator) -> Streets:
    """The frames of the first street ten times, as if they were of other places."""
    first = streets.table.select(streets.table.frame < FRAMES)
    more = [replace(first, frame=first.frame + 1000 * copy) for copy in range(1, 10)]
    table = replace(concatenate([streets.table, *more]), metadata=streets.table.metadata)
    return replace(streets, table=table)


CHANGES: dict[str, Callable[[Streets, np.random.Generator], Streets]] = {
    "as they are": lambda streets, rng: streets,
    "without pairs": without_pairs,
    "tied by 0.02 deg 0.3 cm": tied,
    "first camera without matches, tied": lambda streets, rng: tied(
        few_frames(streets, rng, count=0), rng
    ),
    "1 frame of the first camera": partial(few_frames, count=1),
    "3 frames of the first camera": partial(few_frames, count=3),
    "first street 10 times": repeated,
}
