"""What windows tell on rigs that their weights were not trained on: leave one rig out.

    python -m benchmarks.accuracy.left_out_windows --scenes out/weights

The windows of ``window_weights`` on every recording are scored by several weights:

    alike               1 for every window, the hand-made score
    package             the shipped network
    rendered            trained here, on fewer windows of the same rendered scenes
    permissive          the same and the recordings whose licence lets anyone use them
    self-trained        rendered, and one recording at the poses that ``calibrate`` found
    others' references  rendered, and all recordings of other rigs at their references

The second table has rendered scenes by sensor, three LiDARs on two rigs, and weights trained on the
scenes of the other five (``--only rendered`` makes it alone).

No recording of a rig trains the weights that judge it, except for self-training. Sharpness, one
number, is fitted on the permissive recordings of other rigs.

A window's likelihood is of the nine shifts about the truth against chance, in nats: 0 says nothing,
lower is better. The share counts windows whose best shift is within a step of the truth, by weight.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks.accuracy import ledger
from benchmarks.accuracy.scenes import Folders
from benchmarks.accuracy.window_weights import (
    MOST,
    REACH,
    RECORDINGS,
    Sample,
    negative_log_likelihood,
    rendered,
    sample_of,
    summed_z,
    train,
)
from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph import calibrate, perturb
from calibgraph.matching.structure.training.loss import damped
from calibgraph.matching.structure.window_weights import window_network

MOST["less"] = 120  # windows of a rendered image: a fifth of what the package's have seen
PERMISSIVE = ("surround6", "acfr_vlp16_fisheye")
TAUGHT = "kitti_raw_0005"  # for itself: the pose that ``calibrate`` finds, and passes
SENSORS = tuple(f"{(16, 32, 64)[n % 3]} beams, {('pair', 'wide rig')[n % 2]}" for n in range(6))
"""In the order of the rendered scenes, see ``window_weights.rendered``."""
SHARPNESS = np.geomspace(0.05, 40.0, 24)
GUESS_DEG, GUESS_M = 2.0, 0.2

ALIKE, PACKAGE, OWN = "alike", "package", f"{TAUGHT} by itself"

Weights = Callable[[np.ndarray], np.ndarray]


def main() -> None:
    """Train per rig, judge every recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "weights")
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("recorded", "rendered"), help="one of the tables")
    add_record_option(parser)
    options = parser.parse_args()
    folders = Folders(options.realdata, None)
    drawn = [sample_of(*scene, "less") for scene in rendered(options.scenes)]
    tables = []
    if options.only != "rendered":
        tables.append(recorded_table(folders, drawn, options.seed))
    if options.only != "recorded":
        tables.append(rendered_table(folders, drawn, options.seed))
    publish("accuracy.left_out_windows", tables, record=options.record)


def rendered_table(folders: Folders, drawn: list[Sample], seed: int) -> Table:
    """Sensors of rendered scenes, by weights that have seen the other sensors."""
    known = [sample_of(*folders.load(name), "recorded") for name in PERMISSIVE]
    rows = []
    for number, sensor in enumerate(SENSORS):
        own = drawn[number :: len(SENSORS)]
        others = [s for n, s in enumerate(drawn) if n % len(SENSORS) != number]
        kinds = [(of, sharpness_of(of, known)) for of in (_alike, train(others, seed).weights)]
        rows.append((sensor, *cells(joined(own), kinds)))
        print(rows[-1], flush=True)
    heads = [f"{what}, {kind}" for what in ("nats", "share", "z") for kind in ("alike", "rendered")]
    return Table("Windows of rendered sensors that were left out", ("sensor", *heads), tuple(rows))


def joined(samples: Sequence[Sample]) -> Sample:
    """All windows as one sample."""
    features = np.concatenate([sample.features for sample in samples])
    return Sample(features, torch.cat([sample.scores for sample in samples]))


def recorded_table(folders: Folders, drawn: list[Sample], seed: int) -> Table:
    """Recordings, by every kind of weights."""
    recorded = {name: sample_of(*folders.load(name), "recorded") for name in RECORDINGS}
    recorded[OWN] = self_taught(folders)
    known = {ALIKE: _alike, PACKAGE: window_network().weights}
    trained: Trained = {frozenset({name}): weights for name, weights in known.items()}
    rows = []
    for rig, names in rigs().items():
        weights = list(weights_for(rig, drawn, recorded, trained, seed))
        rows += [(name, *cells(recorded[name], weights)) for name in names]
        print(*rows[-len(names) :], sep="\n", flush=True)
    kinds = (
        "alike", "package", "rendered", "permissive", "self-trained", "others' references",
    )  # fmt: skip
    heads = [f"{what}, {kind}" for what in ("nats", "share", "z") for kind in kinds]
    return Table("Windows of rigs that were left out", ("recording", *heads), tuple(rows))


def rigs() -> Mapping[str, Sequence[str]]:
    """Recordings by rig: KITTI's are one vehicle's."""
    found: dict[str, list[str]] = {}
    for name in RECORDINGS:
        found.setdefault("kitti" if name.isdigit() or "kitti" in name else name, []).append(name)
    return found


def self_taught(folders: Folders) -> Sample:
    """A recording's windows at the poses of its own result."""
    dataset, truth = folders.load(TAUGHT)
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=0, uniform=True)
    result = calibrate(dataset, guess)
    if result.verdict.status != "PASS":
        raise RuntimeError(f"{TAUGHT} did not pass, so nobody may be taught by it")
    return sample_of(dataset, result.rig, "recorded")


Trained = dict[frozenset[str], Weights]
"""Weights by the names of the recordings that they have seen."""


def weights_for(
    rig: str, drawn: list[Sample], recorded: Mapping[str, Sample], trained: Trained, seed: int
) -> Iterator[tuple[Weights, float]]:
    """Weights and sharpness of each kind; self-training alone may have seen the rig."""
    others = {name for other, names in rigs().items() if other != rig for name in names}
    permissive = others & {*PERMISSIVE}
    for names in ({ALIKE}, {PACKAGE}, set[str](), permissive, {OWN}, others):
        key = frozenset(names)
        if key not in trained:
            samples = [*drawn, *(recorded[name] for name in sorted(names))]
            trained[key] = train(samples, seed).weights
        yield trained[key], sharpness_of(trained[key], [recorded[name] for name in permissive])


def _alike(features: np.ndarray) -> np.ndarray:
    return np.full(len(features), 0.999, dtype=np.float32)  # of 1 a score has no likelihood of null


def sharpness_of(weights: Weights, samples: Sequence[Sample]) -> float:
    """The likeliest on some windows."""
    losses = [
        sum(_loss(sample, weights(sample.features), one) * len(sample.features)
            for sample in samples)
        for one in SHARPNESS
    ]  # fmt: skip
    return float(SHARPNESS[int(np.argmin(losses))])


def _loss(sample: Sample, weights: np.ndarray, sharpness: float) -> float:
    sharp = torch.tensor(sharpness)
    return float(negative_log_likelihood(torch.as_tensor(weights), sample.scores, sharp))


def cells(sample: Sample, kinds: Sequence[tuple[Weights, float]]) -> list[str]:
    """A recording's row: the likelihood by each kind of weights, the shares, the z-scores."""
    scores = np.nan_to_num(sample.scores.numpy(), nan=-np.inf)
    row, column = np.divmod(scores.reshape(len(scores), -1).argmax(axis=1), scores.shape[2])
    right = np.maximum(np.abs(row - REACH), np.abs(column - REACH)) <= 1
    weighed = [(weights(sample.features), sharp) for weights, sharp in kinds]
    return [
        *(f"{_loss(sample, weights, sharp):.3f}" for weights, sharp in weighed),
        *(f"{np.average(right, weights=weights):.3f}" for weights, _ in weighed),
        *(f"{summed_z(damped(sample.scores, torch.as_tensor(weights)).numpy()):.1f}"
          for weights, _ in weighed),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
