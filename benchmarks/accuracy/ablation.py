"""What each part of the matcher `structure` contributes: the same runs without one part.

    python -m benchmarks.accuracy.ablation [--rounds 00 --search "" --parts "all of it"]

Rounds: from within 0.3 deg and 6 cm, errors against the reference. Search: cameras found from
within 20 deg and 1.5 m (success: within 1.5 deg and 25 cm, what the rounds correct), and its time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.stats import qmc

from benchmarks.accuracy import ledger
from benchmarks.accuracy.scenes import Folders
from benchmarks.tables import Table, add_record_option, publish
from calibgraph import Dataset, Rig, StructureMatcher, evaluate, perturb
from calibgraph.matching.structure import (
    box_search,
    global_search,
    matcher,
    pose_refinement,
    pose_search,
    shift_scores,
    windows,
)
from calibgraph.matching.structure.correlation_maps import CorrelationMaps
from calibgraph.matching.structure.pose_refinement import Candidate
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds

REACHED_DEG, REACHED_CM = 1.5, 25.0
Part = Callable[[], AbstractContextManager[Any]]


ROUNDS_COLUMNS = (
    "part", "data", "cameras [deg]", "[cm]", "pairs [deg]", "[cm]", "z-score", "time [s]"
)  # fmt: skip
SEARCH_COLUMNS = ("part", "data", "cameras", "found", "wrongly accepted", "time [s]")


def main() -> None:
    """Run both tables."""
    options = parse_options()
    folders = Folders(options.realdata, None)
    tables = []
    for title, names, parts, measure, columns in (
        ("Rounds", options.rounds, ROUNDS, _measure_rounds, ROUNDS_COLUMNS),
        ("Search", options.search, SEARCH, _measure_search, SEARCH_COLUMNS),
    ):
        rows = []
        for data in names:
            for part, without in parts.items():
                if options.parts is None or part in options.parts:
                    with without():
                        cells = measure(folders.load(data), options.starts)
                    rows.append((part, data, *cells))
                    print(", ".join(rows[-1]), flush=True)
        tables += [Table(f"{title}, {options.starts} starts", columns, tuple(rows))] if rows else []
    publish("accuracy.ablation", tables, record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words: Callable[[str], list[str]] = lambda text: [n for n in text.split(",") if n]  # noqa: E731
    parser.add_argument("--rounds", type=words, default=["00", "05+06+07+08"], help="data, or ''")
    parser.add_argument("--search", type=words, default=["05"], help="data, or ''")
    parser.add_argument("--parts", type=words, help="some of the parts; all by default")
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    add_record_option(parser)
    return parser.parse_args()


def _measure_rounds(data: tuple[Dataset, Rig], starts: int) -> tuple[str, ...]:
    """Errors after the last rounds."""
    frames, truth = data
    found, z_scores, begun = [], [], time.perf_counter()
    for seed in range(starts):
        guess = perturb(truth, rotation_deg=0.3, translation_m=0.06, seed=seed, uniform=True)
        rounds = StructureMatcher(search_deg=None, search_m=None, levels=matcher.LEVELS[3:])
        matched = match_in_rounds(frames, guess, rounds, progress=no_progress)
        z_scores += matched.correspondences.findings.z_score.values()
        found.append(evaluate(matched.solution.solved_rig, truth))
    cameras = [_error(camera) for one in found for camera in one.cameras.values()]
    pairs = [_error(pair) for one in found for pair in one.pairs.values()]
    seconds = (time.perf_counter() - begun) / starts
    (camera_deg, camera_cm), (pair_deg, pair_cm) = np.mean(cameras, axis=0), np.mean(pairs, axis=0)
    return (
        f"{camera_deg:.3f}", f"{camera_cm:.2f}", f"{pair_deg:.3f}", f"{pair_cm:.2f}",
        f"{np.mean(z_scores):.1f}", f"{seconds:.1f}",
    )  # fmt: skip


def _measure_search(data: tuple[Dataset, Rig], starts: int) -> tuple[str, ...]:
    """Cameras found, and wrongly accepted."""
    frames, truth = data
    right, wrong, begun = 0, 0, time.perf_counter()
    for seed in range(starts):
        guess = perturb(truth, rotation_deg=20, translation_m=1.5, seed=seed, uniform=True)
        structure = StructureMatcher(seed=seed)
        start = structure.locate(frames, guess, out_of_time=lambda: False, progress=no_progress)
        errors = evaluate(start.rig, truth).cameras
        for name in start.findings.found:
            degrees, centimetres = _error(errors[name])
            reached = degrees < REACHED_DEG and centimetres < REACHED_CM
            right, wrong = right + reached, wrong + (not reached)
    seconds = (time.perf_counter() - begun) / starts
    return str(starts * len(truth.cameras)), str(right), str(wrong), f"{seconds:.1f}"


def _error(error: Any) -> tuple[float, float]:
    return error.rotation_error_deg, error.translation_error_cm


_DESCRIBE_WINDOWS = windows.describe_windows


def _without_column(column: int) -> Part:
    """Windows without inverse range (0) or intensity (1)."""

    def flat(cloud: Any, members: Any, *others: Any) -> None:
        _DESCRIBE_WINDOWS(cloud, members, *others)
        others[4][..., column] = 0.0  # of the basis

    return lambda: patch.object(windows, "describe_windows", flat)


def _keep_hidden(cloud: Any, members: Any, *others: Any) -> None:
    """Points behind a silhouette stay where they are."""
    _DESCRIBE_WINDOWS(cloud, members, *others)
    moved_m, front = others[2:4]
    moved_m[:], front[:] = cloud[0][members], True


def _without_trend(cloud: Any, members: Any, counts: Any, _: bool, *others: Any) -> None:
    _DESCRIBE_WINDOWS(cloud, members, counts, False, *others)


def _shares(*arguments: Any) -> None:
    _SCORE_WINDOWS(*arguments[:6], False, *arguments[7:])


def _with_chance(*arguments: Any) -> None:
    _SCORE_WINDOWS(*arguments[:8], 0.0)


_SCORE_WINDOWS = shift_scores.score_windows


def _levels(levels: Sequence[Any]) -> Part:
    return lambda: patch.object(matcher, "LEVELS", (*LEVELS[:3], *levels))


ROUNDS: Mapping[str, Part] = {
    "all of it": nullcontext,
    "no intensity": _without_column(1),
    "no inverse range": _without_column(0),
    "silhouettes not corrected": lambda: patch.object(windows, "describe_windows", _keep_hidden),
    "windows with hidden points": lambda: patch.object(
        shift_scores, "find_visible", lambda angles, *_: np.ones(len(angles), np.bool_)
    ),
    "linear parts removed": lambda: patch.object(windows, "describe_windows", _without_trend),
    "shares, not likelihoods": lambda: patch.object(shift_scores, "score_windows", _shares),
    "share of unrelated windows kept": lambda: patch.object(
        shift_scores, "score_windows", _with_chance
    ),
    "without round 4": _levels(LEVELS[4:]),
    "without round 6": _levels(LEVELS[3:5]),
    "without rounds 5 and 6": _levels(LEVELS[3:4]),
}


def _stay(_: Any, body: Any) -> Candidate:
    """In place of an approach; all candidates have the same z-score."""
    return Candidate(body, 0.0)


def _sample_without_shifts(
    coarse: CorrelationMaps, _: Any, box: box_search.Box, rng: np.random.Generator
) -> tuple[Any, Any]:
    """Samples of the box and their z-scores, as they are; for bodies of one camera."""
    unit = qmc.Sobol(6, seed=rng).random(box_search.SAMPLES)
    displacements = (2 * unit - 1) * box.half_widths
    return displacements, coarse.z_scores(box.transforms(displacements))


def _plain_sums() -> AbstractContextManager[Any]:
    """Sums of scores over the spread of all groups, not of those that are seen."""
    return patch.multiple(
        CorrelationMaps,
        variances=property(lambda self: np.zeros(len(self.maps))),
        _variance_floor=property(lambda self: float(self.maps.var(axis=(1, 2)).sum())),
    )


SEARCH: Mapping[str, Part] = {
    "all of it": nullcontext,
    "cameras do not help each other": lambda: patch.object(
        global_search.Locator, "_propose", lambda _: False
    ),
    "samples not shifted": lambda: patch.object(
        box_search, "_sample_camera", _sample_without_shifts
    ),
    "one roll": lambda: patch.object(pose_search, "ROLLS_RAD", pose_search.ROLLS_RAD[:1]),
    "no approach": lambda: patch.object(pose_search, "approach", _stay),
    "all groups' spread": _plain_sums,
    "one search per camera": lambda: patch.object(global_search, "SEARCHES", 1),
    "refined once": lambda: patch.object(pose_refinement, "MAX_REFINEMENTS", 0),
    "no intensity": _without_column(1),
    "no inverse range": _without_column(0),
}


if __name__ == "__main__":
    main()
