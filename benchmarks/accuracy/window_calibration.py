"""Whether a monotone calibration of windows' scores is a better likelihood than the scores.

    python -m benchmarks.accuracy.window_calibration --scenes out/weights

The logarithm of how much more often a score is seen at the true shift than at another one, against
the score: an isotonic regression per level, of equally many windows of each rig. It is fitted on
rendered scenes, or on the recordings of other rigs that are not in ``KEPT``. A softmax of that over
shifts, sharpened, is a window's likelihood: of the nine shifts about the truth against chance, in
nats. 0 says nothing, higher is better.

Sharpness is one number of the same scenes or recordings ("fixed"), or as in the posterior of a
pose: the mean score at the truth over the scores' variance, of the recording itself ("own").
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.special import logit, logsumexp

from benchmarks.accuracy import ledger
from benchmarks.accuracy.left_out_windows import rigs
from benchmarks.accuracy.scenes import Folders
from benchmarks.accuracy.window_weights import RECORDINGS, rendered
from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph import Dataset, Rig
from calibgraph.io.dataset import spread_out
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.score_kernel import score_windows
from calibgraph.matching.structure.shift_scores import downscale_log_gray, select_windows
from calibgraph.matching.structure.visibility import find_places

KEPT = "kitti_raw_0005", "nuscenes_a", "opencalib_a", "vlp16_distorted"
REACH, MIDDLE = 12, slice(11, 14)  # steps to each side that are kept; the nine about the truth
FRAMES, MOST, RENDERED = 4, 250, 3  # windows of an image; every third rendered scene
SHARPNESS, SCORES = np.geomspace(0.05, 40.0, 24), np.arange(0.0, 2.5, 0.01)

Scores = np.ndarray
"""(w, s, s) scores of windows by shift from the truth, in the middle."""
Calibration = Callable[[Scores], Scores]


def main() -> None:
    """A table per level, a row per recording."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "weights")
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    add_record_option(parser)
    options = parser.parse_args()
    folders = Folders(options.realdata, None)
    recorded = {name: list(scores_of(*folders.load(name))) for name in RECORDINGS}
    scenes = [list(scores_of(*scene)) for scene in list(rendered(options.scenes))[::RENDERED]]
    tables = []
    for number in range(len(LEVELS) - 1):
        of_level = {name: scores[number] for name, scores in recorded.items()}
        tables.append(table_of(number, of_level, [scene[number] for scene in scenes]))
    publish("accuracy.window_calibration", tables, record=options.record)


def scores_of(dataset: Dataset, rig: Rig) -> Iterator[Scores]:
    """At every level but the last, which is the one before."""
    frames = spread_out(dataset.frames, FRAMES)
    cache, size = cache_of(frames, FrameCache()), 2 * REACH + 1
    for level in LEVELS[:-1]:
        found = [np.empty((0, size, size), np.float32)]
        for frame, (name, camera) in product(frames, rig.cameras.items()):
            if name in frame.image_paths:
                gray, cloud = cache.image(frame, name, camera), cache.cloud(frame)
                image, scale = downscale_log_gray(gray, camera, level.step_rad, level.blur_steps)
                alike = replace(level, weighed=False)
                windows = select_windows(cloud, camera, alike, max_windows=MOST)
                places = find_places(windows.rays_m, cloud.viewpoint_lidar_m(camera), camera, scale)
                grids = np.zeros((len(places), size, size), np.float32)
                number, first = np.arange(len(grids), dtype=np.int32), np.array([-REACH, -REACH])
                counts, basis = windows.counts, windows.basis
                score_windows(image, places, counts, basis, number, first, level.fine, grids)
                found.append(grids)
        yield np.concatenate(found)


def table_of(number: int, recorded: Mapping[str, Scores], scenes: Sequence[Scores]) -> Table:
    """The recordings at one level."""
    rows, of_scenes = [], calibrations(scenes)
    for names in rigs().values():
        others = [
            np.concatenate([recorded[name] for name in other if name not in KEPT])
            for other in rigs().values()
            if other != names and {*other} - {*KEPT}
        ]
        kinds = (*calibrations(others), of_scenes[1])
        for name in names:
            cells = [
                value for kind in kinds
                for value in (nats(kind(recorded[name])), nats(own(kind(recorded[name]))))
            ]  # fmt: skip
            label = name + ", kept out" * (name in KEPT)
            rows.append((label, *map("{:.3f}".format, cells)))
    kinds = "score", "calibrated", "calibrated on rendered scenes"
    heads = [f"{kind}, {sharp}" for kind in kinds for sharp in ("fixed", "own")]
    return Table(f"Nats of a window at level {number}", ("recording", *heads), tuple(rows))


def calibrations(rigs: Sequence[Scores]) -> tuple[Calibration, Calibration]:
    """The scores themselves and calibrated ones, both sharpened for these rigs."""
    edges = [-np.inf, *SCORES, np.inf]
    true, other = (
        np.mean([np.histogram(part(one), edges)[0] / part(one).size for one in rigs], axis=0)
        for part in (lambda one: one[:, MIDDLE, MIDDLE], lambda one: one)
    )
    seen = np.maximum(true + other, 1e-9)
    share = isotonic_regression(true / seen, weights=seen).x
    ratio = logit(np.clip(share, 1e-3, 1 - 1e-3))
    at = np.append(SCORES[0], SCORES + (SCORES[1] - SCORES[0]) / 2)

    def calibrated(scores: Scores) -> Scores:
        return np.interp(scores, at, ratio)

    return _sharpened(lambda scores: scores, rigs), _sharpened(calibrated, rigs)


def _sharpened(of: Calibration, rigs: Sequence[Scores]) -> Calibration:
    some = [of(one[:MOST]) for one in rigs]
    gains = [sum(nats(sharp * one) for one in some) for sharp in SHARPNESS]
    best = SHARPNESS[int(np.argmax(gains))]
    return lambda scores: best * of(scores)


def own(scores: Scores) -> Scores:
    """Sharpened as in the posterior of a pose, by the scores themselves."""
    above = scores - scores.mean(axis=(1, 2), keepdims=True)
    amplitude = max(float(above[:, MIDDLE, MIDDLE].mean()), 0.0)
    return amplitude / max(float(above.var(axis=(1, 2)).mean()), 1e-9) * above


def nats(scores: Scores) -> float:
    """Mean log probability of the nine middle shifts, less that under a uniform distribution."""
    found = logsumexp(scores[:, MIDDLE, MIDDLE], axis=(1, 2)) - logsumexp(scores, axis=(1, 2))
    return float(found.mean() + np.log(scores[0].size / 9))


if __name__ == "__main__":
    main()
