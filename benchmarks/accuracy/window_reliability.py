"""Whether windows are right as often as their scores state.

    python -m benchmarks.accuracy.window_reliability

The softmax of a window's weighed score over shifts, sharpened by one factor for all, is the
probability of each shift. The factor is the likeliest on the recordings ``FITTED``, which a licence
lets anyone use; the other rigs are left out. A window states the probability of its best three by
three shifts, and is right if the truth is among them. Windows go into fifths by what they state.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import uniform_filter

from benchmarks.accuracy import ledger
from benchmarks.accuracy.scenes import Folders
from benchmarks.accuracy.window_weights import REACH, RECORDINGS, Sample, sample_of
from benchmarks.tables import Table, add_record_option, publish
from calibgraph.matching.structure.training.loss import damped
from calibgraph.matching.structure.window_weights import window_network

FITTED = ("surround6", "acfr_vlp16_fisheye")
SHARPNESS = (4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 18.0)
MOST, FIFTHS = 3000, 5


def main() -> None:
    """Fit the sharpness; a row per recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    add_record_option(parser)
    options = parser.parse_args()
    folders = Folders(options.realdata, None)
    samples = {name: weighed(sample_of(*folders.load(name), "recorded")) for name in RECORDINGS}
    fitted = np.concatenate([samples[name] for name in FITTED])
    sharpness = min(SHARPNESS, key=lambda one: float(-np.log(stated(fitted, one)[2]).mean()))
    rows = [(name, *reliability(scores, sharpness)) for name, scores in samples.items()]
    columns = ("recording", "mean deviation", "largest", "surest fifth: stated", "right")
    title = f"stated probability of windows, sharpened {sharpness:g} times, and how often it holds"
    table = Table(title, columns, tuple(rows))
    publish("accuracy.window_reliability", [table], record=options.record)


def weighed(sample: Sample) -> np.ndarray:
    """(w, s, s) scores of some windows, by their weights."""
    rows = np.random.default_rng(0).permutation(len(sample.features))[:MOST]
    weights = torch.as_tensor(window_network().weights(sample.features[rows]))
    return np.asarray(damped(sample.scores[rows], weights))


def stated(scores: np.ndarray, sharpness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per window the stated probability, whether it is right, and the probability of the truth."""
    logits = np.where(np.isnan(scores), -np.inf, sharpness * scores)
    shares = np.exp(logits - logits.max(axis=(1, 2), keepdims=True))
    shares /= shares.sum(axis=(1, 2), keepdims=True)
    around = 9 * np.stack([uniform_filter(one, 3, mode="constant") for one in shares])
    row, column = np.divmod(around.reshape(len(around), -1).argmax(axis=1), scores.shape[2])
    right = np.maximum(np.abs(row - REACH), np.abs(column - REACH)) <= 1
    return around.max(axis=(1, 2)), right, around[:, REACH, REACH]


def reliability(scores: np.ndarray, sharpness: float) -> Sequence[str]:
    """Mean and largest deviation over the fifths; both numbers of the surest one."""
    said, right, _ = stated(scores, sharpness)
    fifths = np.array_split(np.argsort(said), FIFTHS)
    pairs = [(said[rows].mean(), right[rows].mean()) for rows in fifths]
    apart = [abs(a - b) for a, b in pairs]
    return [f"{value:.3f}" for value in (np.mean(apart), max(apart), *pairs[-1])]


if __name__ == "__main__":
    main()
