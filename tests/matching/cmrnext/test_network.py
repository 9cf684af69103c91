"""The network against its description, against published test vectors, and against itself."""

import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from calibgraph.matching.cmrnext.correlation import MOST_BYTES, Correlation
from calibgraph.matching.cmrnext.network import Architecture, CmrNext
from tests.matching.cmrnext import reference_network

WAYS = (MOST_BYTES, 0)
"""All pairs at once, and only the requested ones."""


def test_all_pairs_and_only_the_requested_ones_agree() -> None:
    generator = torch.Generator().manual_seed(1)
    lidar, image = (torch.randn(2, 32, 16, 24, generator=generator) for _ in range(2))
    spread = torch.rand(2, 2, 16, 24, generator=generator) * 60 - 20  # inside, across the edge, out
    one, two = (Correlation(lidar, image, most).window(spread) for most in WAYS)
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        one, reference_network.lookup(lidar, image, spread), atol=1e-4, rtol=0
    )


def test_correlation_far_outside_is_zero() -> None:
    lidar = torch.ones(1, 8, 16, 16)
    for value in (1e30, -1e30, torch.nan, torch.inf):
        positions = torch.full((1, 2, 16, 16), value)
        for most in WAYS:
            assert not Correlation(lidar, lidar, most).window(positions).any()


ROUNDING = float(np.finfo(np.float32).eps)
ARCHITECTURES = {
    "A: LiDAR context": Architecture(width=8),
    "B: RGB context": Architecture(width=8, context="rgb"),
    "C: no encoding": Architecture(width=8, fourier_levels=-1),
    "D: reflectance": Architecture(width=16, reflectance=True),
}


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


def inputs(architecture: Architecture, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.randn(batch, 3, 128, 192, generator=generator)
    return rgb, torch.randn(batch, architecture.lidar_channels, 128, 192, generator=generator)


@pytest.mark.parametrize(
    "name",
    [
        name if name[0] == "A" else pytest.param(name, marks=pytest.mark.slow)
        for name in ARCHITECTURES
    ],
)
def test_network_computes_its_description(name: str) -> None:
    architecture = ARCHITECTURES[name]
    model = generated(architecture)
    rgb, lidar = inputs(architecture)
    with torch.inference_mode():
        found = model(rgb, lidar, iterations=3)
        flow = reference_network.flow_of(
            model.state_dict(), rgb, lidar, context=architecture.context, iterations=3
        )
    # float32 rounding through some 60 layers: 1e-6 relative per layer, of flows of several pixels.
    torch.testing.assert_close(found.flow_px, flow, atol=2e-4, rtol=0)


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
