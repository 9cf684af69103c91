"""Train the network that weighs windows on rendered scenes; judge it on recordings.

    python -m tools.window_weights --scenes out/weights --write
    python -m tools.window_weights --judge

Every window is scored at all shifts about the true alignment, as the matcher's fine levels do. Its
weight w turns its score s into -log(1 - w (1 - exp(-s))); the loss is the negative logarithm of
what a softmax of these, sharpened by one common factor, gives the true shift and its neighbours.
Scenes are rendered with seeds from 9000 on, which no other benchmark has. No recording takes part:
the table shows the summed score at a recording's reference, in standard deviations of chance, with
all windows of one weight and with the network's.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.accuracy import ledger
from benchmarks.accuracy.scenes import Folders
from benchmarks.tables import ROOT, Table, parser_of, publish
from calibgraph import Dataset, Rig, load_dataset, simulate_street
from calibgraph.files import write_text
from calibgraph.matching.structure.directions import find_places
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.score_kernel import score_windows
from calibgraph.matching.structure.shift_scores import select_windows
from calibgraph.matching.structure.window_weights import (
    FEATURES,
    LARGEST,
    PACKAGE_FILE,
    WindowNetwork,
    window_network,
)
from calibgraph.matching.structure.windows import Windows
from tools.scenes.scan_errors import draw_scan_errors
from tools.scenes.sensor_streets import aligned_rig, pair, wide
from tools.scenes.surroundings import SURROUNDINGS

LEVEL = replace(LEVELS[3], weighed=False)
REACH = 12  # steps to each side that are kept
FIRST_SEED, STREETS, OTHERS, FRAMES = 9000, 48, 6, 3
MOST = {"rendered": 800, "recorded": 1000}  # windows of an image
HIDDEN, EPOCHS, BATCH, RATE, DECAY, NOISE = 16, 8, 512, 8e-3, 1e-2, 0.5
SHARPNESS = 2.5  # logarithm to begin with: from 0 all weights would grow to 1 before it does
RECORDINGS = (
    "00", "05", "06", "07", "08", "10", "kitti_places", "kitti_raw_0005", "surround6",
    "nuscenes_a", "opencalib_a", "sustech", "vlp16_distorted", "acfr_vlp16_fisheye",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sample:
    """The windows of a scene.

    Attributes:
        features: (w, f).
        scores: (w, s, s) by shift [v, u] from the truth, in the middle; NaN beyond the reach.
    """

    features: np.ndarray
    scores: torch.Tensor


def main() -> None:
    """Train, write, judge."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "weights")
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="train, and write into the package")
    parser.add_argument("--judge", action="store_true", help="print the table of the recordings")
    options = parser.parse_args()
    if options.write:
        samples = [sample_of(*scene, "rendered") for scene in rendered(options.scenes)]
        save(train(samples, options.seed))
        window_network.cache_clear()
    if options.judge:
        publish([judge(options.realdata)])


def rendered(scenes: Path) -> Iterator[tuple[Dataset, Rig]]:
    """Streets and other surroundings, rendered where they are missing, with their alignments."""
    places = ["street"] * STREETS + [name for name in SURROUNDINGS if name != "street"] * OTHERS
    for number, where in enumerate(places):
        beams, make = (16, 32, 64)[number % 3], (pair, wide)[number % 2]
        folder, truth, seed = scenes / f"{where}_{number}", make(), FIRST_SEED + number
        errors = draw_scan_errors(beams, 1.0, np.random.default_rng([19, number]))
        if not (folder / "rig.yaml").exists():
            simulate_street(
                folder, truth, beams=beams, frames=FRAMES, seed=seed, sensor_errors=errors,
                vary_layout=True, build_scene=SURROUNDINGS[where],
            )  # fmt: skip
        yield load_dataset(folder, truth), aligned_rig(truth, truth, folder, beams, errors)


def sample_of(dataset: Dataset, rig: Rig, of: str, frames: int = 4) -> Sample:
    """The windows of all cameras in some frames."""
    chosen = np.unique(np.linspace(0, len(dataset.frames) - 1, frames).round().astype(int))
    listed = [dataset.frames[number] for number in chosen]
    cache, features, scores = cache_of(listed, FrameCache()), [], []
    for frame in listed:
        cloud = cache.cloud(frame)
        for name in rig.cameras.keys() & frame.image_paths.keys():
            camera = rig.cameras[name]
            image, scale = cache.image(frame, name=name, camera=camera).log_gray(
                camera, LEVEL.step_rad, LEVEL.blur_steps
            )
            windows = select_windows(cloud, camera, LEVEL, max_windows=MOST[of])
            viewpoint_m = cloud.viewpoint_lidar_m(camera)
            reach = min(REACH, round(LEVEL.reach_rad * camera.lens.pixels_per_rad * scale.max()))
            reach = max(reach, 3)
            places = find_places(windows["rays_m"], viewpoint_m, camera, scale)
            margins = ((0, 0), (REACH - reach,) * 2, (REACH - reach,) * 2)
            grids = score_each(image, places, windows, reach)
            scores.append(np.pad(grids, margins, constant_values=np.nan))
            features.append(windows["features"])
    return Sample(np.concatenate(features), torch.tensor(np.concatenate(scores)))


def train(samples: Sequence[Sample], seed: int) -> WindowNetwork:
    """The trained network."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    trainee = Trainee(np.concatenate([sample.features for sample in samples]))
    sharpness = torch.nn.Parameter(torch.tensor(SHARPNESS))
    groups: list[dict[str, Any]] = [
        {"params": trainee.layers.parameters()},
        {"params": [sharpness], "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(groups, RATE / 2, weight_decay=DECAY)
    steps = EPOCHS * sum(-(-len(sample.features) // BATCH) for sample in samples)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(EPOCHS):
        for sample, rows in batches(samples):
            weights = trainee.weights(sample.features[rows.numpy()], NOISE)
            loss = negative_log_likelihood(weights, sample.scores[rows], sharpness.exp())
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
        print(f"sharpness {float(sharpness.detach().exp()):.1f}", flush=True)
    count = sum(len(sample.features) for sample in samples)
    return trainee.to_network(
        f"python -m tools.window_weights --write: {count} windows of "
        f"{len(samples)} rendered scenes, seeds from {FIRST_SEED} on"
    )


class Trainee:
    """The network that is trained, in torch, of random layers; for features (w, f) like these."""

    def __init__(self, features: np.ndarray) -> None:
        values = torch.as_tensor(features).double()
        self._mean, self._spread = values.mean(0), values.std(0, correction=0) + 1e-6
        sizes = pairwise((len(FEATURES), HIDDEN, HIDDEN, 1))
        self._linear = [torch.nn.Linear(*size) for size in sizes]
        *hidden, last = self._linear
        gelus = [(layer, torch.nn.GELU(approximate="tanh")) for layer in hidden]
        self.layers = torch.nn.Sequential(*(module for pair in gelus for module in pair), last)

    def weights(self, features: np.ndarray, noise: float = 0.0) -> torch.Tensor:
        """(w,) of windows with features (w, f), differentiable, with noise on the features."""
        values = (torch.as_tensor(features).double() - self._mean) / self._spread
        values = (values + noise * torch.randn_like(values)).float()
        logits: torch.Tensor = self.layers(values).clamp(-LARGEST, LARGEST)[:, 0]
        return torch.sigmoid(logits)

    def to_network(self, how: str) -> WindowNetwork:
        """As the matcher uses it, with a description of its training."""
        layers = [(layer.weight.detach().T, layer.bias.detach()) for layer in self._linear]
        arrays = tuple((matrix.double().numpy(), bias.double().numpy()) for matrix, bias in layers)
        return WindowNetwork(self._mean.numpy(), self._spread.numpy(), arrays, how)


def save(network: WindowNetwork) -> None:
    """Write the package's file, numbers to five digits."""

    def rounded(values: np.ndarray) -> list[float]:
        return [float(f"{value:.5g}") for value in values.tolist()]

    content = {
        "format": "calibgraph-window-weights/1", "how": network.how, "features": list(FEATURES),
        "mean": rounded(network.mean), "spread": rounded(network.spread),
        "layers": [{"matrix": [rounded(row) for row in matrix], "bias": rounded(bias)}
                   for matrix, bias in network.layers],
    }  # fmt: skip
    write_text(PACKAGE_FILE, json.dumps(content) + "\n")


def damped(scores: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """-log(1 - w (1 - exp(-s))) of scores (w, ...) by weights (w,)."""
    shaped = weights.reshape(-1, *[1] * (scores.ndim - 1))
    return -torch.log1p(-shaped * -torch.expm1(-scores))


def score_each(image: np.ndarray, places: np.ndarray, windows: Windows, reach: int) -> np.ndarray:
    """(w, s, s) scores of every window by itself, by shift [v, u] up to a reach in steps."""
    count, side = len(windows), 2 * reach + 1
    grids = np.zeros((count, side, side), np.float32)
    group, first = np.arange(count, dtype=np.int32), np.array([-reach, -reach])
    of_windows = windows["count"], windows["basis"]
    score_windows(image, places, *of_windows, group, first, True, grids)
    return grids


def batches(samples: Sequence[Sample]) -> Iterator[tuple[Sample, torch.Tensor]]:
    """All windows once, in batches of one scene, shuffled."""
    listed = [
        (sample, rows)
        for sample in samples
        for rows in torch.randperm(len(sample.features)).split(BATCH)  # type: ignore[no-untyped-call]
    ]
    for number in torch.randperm(len(listed)):
        yield listed[int(number)]


def negative_log_likelihood(
    weights: torch.Tensor, scores: torch.Tensor, sharpness: torch.Tensor
) -> torch.Tensor:
    """Its mean: of the nine middle shifts, against all being alike."""
    beyond = torch.isnan(scores)
    logits = (
        (sharpness * damped(torch.nan_to_num(scores), weights)).masked_fill(beyond, -1e9).flatten(1)
    )
    middle = logits.reshape(scores.shape)[:, REACH - 1 : REACH + 2, REACH - 1 : REACH + 2]
    shifts = (~beyond).sum((1, 2)).float()
    found = torch.logsumexp(middle.flatten(1), 1) - torch.logsumexp(logits, 1)
    return -(found + torch.log(shifts / 9)).mean()


def judge(realdata: Path) -> Table:
    """A row per recording: the sum at the reference, in standard deviations of chance."""
    rows = []
    for name in RECORDINGS:
        sample = sample_of(*Folders(realdata, None).load(name), "recorded")
        weights = window_network().weights(sample.features)
        weighed = damped(sample.scores, torch.as_tensor(weights))
        before, after = summed_z(sample.scores.numpy()), summed_z(weighed.numpy())
        rows.append((name, f"{before:.1f}", f"{after:.1f}", f"{after / before:.2f}",
                     f"{weights.mean():.2f}"))  # fmt: skip
    columns = ("recording", "one weight", "weights", "ratio", "mean weight")
    return Table("z-score of the windows at the reference", columns, tuple(rows))


def summed_z(scores: np.ndarray) -> float:
    """The sum of the nine middle shifts' mean, over chance."""
    middle = scores[:, REACH - 1 : REACH + 2, REACH - 1 : REACH + 2].mean(axis=(1, 2))
    above = middle - np.nanmean(scores, axis=(1, 2))
    return float(above.sum() / np.sqrt(np.nanvar(scores, axis=(1, 2)).sum()))


if __name__ == "__main__":
    main()
