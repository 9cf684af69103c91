"""The network against a literal one, against published test vectors, and against itself."""

import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from calibgraph.matching.cmrnext.correlation import MOST_BYTES, Correlation
from calibgraph.matching.cmrnext.network import Architecture, CmrNext

WAYS = (MOST_BYTES, 0)
"""All pairs at once, and only the requested ones."""


def test_all_pairs_and_only_the_requested_ones_agree() -> None:
    generator = torch.Generator().manual_seed(1)
    lidar, image = (torch.randn(2, 32, 16, 24, generator=generator) for _ in range(2))
    spread = torch.rand(2, 2, 16, 24, generator=generator) * 60 - 20  # inside, across the edge, out
    one, two = (Correlation(lidar, image, most).window(spread) for most in WAYS)
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)


def test_correlation_far_outside_is_zero() -> None:
    lidar = torch.ones(1, 8, 16, 16)
    for value in (1e30, -1e30, torch.nan, torch.inf):
        positions = torch.full((1, 2, 16, 16), value)
        for most in WAYS:
            assert not Correlation(lidar, lidar, most).window(positions).any()


ROUNDING = float(np.finfo(np.float32).eps)
# The flow [px] of a network in plain tensor operations, word for word from the description.
FLOWS: dict[Architecture, list[list[float]]] = {
    Architecture(width=8): [[-4.0673, 2.3361], [-3.19, 7.6453], [6.4009, 2.3045]],
    Architecture(width=8, context="rgb"): [[-3.072, 2.7208], [-2.8784, 7.8087], [4.884, 1.6638]],
    Architecture(width=8, fourier_levels=-1): [
        [-3.0826, 1.6811], [-4.2761, 8.4315], [4.4948, 3.6539],
    ],
    Architecture(width=16, reflectance=True): [
        [-1.9897, -0.3143], [-29.1029, 1.8361], [-0.7553, 5.518],
    ],
}  # fmt: skip


def generated_state(model: CmrNext) -> dict[str, torch.Tensor]:
    """The weights that the test vectors were made with: random, each drawn by its name."""
    state = {}
    for name, like in model.state_dict().items():
        key = name.replace(".downsample.1.", ".norm3.")
        rng = np.random.RandomState(zlib.crc32(key.encode("ascii")))
        values = rng.standard_normal(tuple(like.shape))
        last = key.rsplit(".", 1)[-1]
        if last == "num_batches_tracked":
            values = np.zeros(())
        elif like.ndim == 4:
            values = values * np.sqrt(1.5 / np.prod(like.shape[1:]))
        elif last in ("bias", "running_mean"):
            values = values * {"bias": 0.02, "running_mean": 0.1}[last]
        else:
            values = 1 + 0.1 * (np.abs(values) if last == "running_var" else values)
        state[name] = torch.tensor(values).to(like.dtype)
    return state


def generated(architecture: Architecture) -> CmrNext:
    model = CmrNext(architecture).eval()
    model.load_state_dict(generated_state(model))
    return model


@pytest.mark.parametrize("architecture", FLOWS)
def test_network_computes_its_description(architecture: Architecture) -> None:
    """The flow at three pixels of the second pair of images."""
    rng, channels = np.random.RandomState(0), (3, architecture.lidar_channels)
    rgb, lidar = (rng.standard_normal((2, each, 128, 192)).astype(np.float32) for each in channels)
    with torch.inference_mode():
        found = generated(architecture)(torch.tensor(rgb), torch.tensor(lidar), iterations=3)
    flow = found.flow_px[1, :, [5, 70, 120], [7, 100, 185]].T
    # float32 rounding through some 60 layers: 1e-6 relative per layer, of flows of several pixels.
    np.testing.assert_allclose(flow, FLOWS[architecture], atol=2e-4, rtol=0)


@pytest.mark.ci
@pytest.mark.realdata
def test_published_test_vectors_are_reproduced(reference_folder: Path) -> None:
    """Encoders and lookup to 1e-6 relative, flow to 1e-3 px."""
    vectors = np.load(reference_folder / "cmrnext_golden.npz", allow_pickle=False)
    rgb, lidar = torch.tensor(vectors["rgb"]), torch.tensor(vectors["lidar_input"])
    model = generated(Architecture())
    with torch.inference_mode():
        features = {
            "fmap_lidar": model.fnet_lidar(lidar),
            "fmap_img": model.fnet_img(rgb),
            "cnet": model.cnet(lidar),
        }
        for key, found in features.items():
            # 32 float32 roundings of the largest value: processors sum in other orders.
            largest = np.abs(vectors[key]).max()
            np.testing.assert_allclose(found, vectors[key], atol=32 * ROUNDING * largest, rtol=0)
        y, x = np.indices((16, 24), dtype=np.float32)
        positions = torch.tensor(np.stack([x + 0.3, y - 0.7])[None])
        expected = vectors["corr_at_offset_0.3_-0.7"]
        for most in WAYS:
            maps = [torch.tensor(vectors[key]) for key in ("fmap_lidar", "fmap_img")]
            np.testing.assert_allclose(
                Correlation(*maps, most_bytes=most).window(positions), expected,
                atol=2e-6 * np.abs(expected).max(), rtol=0,
            )  # fmt: skip
        for iterations in (1, 2, 6, 12):
            flow = model(rgb, lidar, iterations=iterations).flow_px
            np.testing.assert_allclose(flow, vectors[f"flow_iter{iterations}"], atol=1e-3, rtol=0)
