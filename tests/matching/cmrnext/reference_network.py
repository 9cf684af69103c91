"""CMRNext written down once more, word for word from its description, slowly: to compare with.

Nothing here is shared with the implementation: correlation by `grid_sample`, the GRU's convolutions
whole, upsampling pixel by pixel. Weights come as a state dict.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional as F

State = Mapping[str, Tensor]


def part(state: State, prefix: str) -> dict[str, Tensor]:
    return {k[len(prefix) + 1 :]: v for k, v in state.items() if k.startswith(prefix + ".")}


def conv(state: State, name: str, x: Tensor, stride: int = 1) -> Tensor:
    weight = state[name + ".weight"]
    padding = (weight.shape[2] // 2, weight.shape[3] // 2)
    return F.conv2d(x, weight, state[name + ".bias"], stride=stride, padding=padding)


def norm(state: State, name: str, x: Tensor) -> Tensor:
    if name + ".running_mean" not in state:
        mean = x.mean(dim=(2, 3), keepdim=True)
        variance = x.var(dim=(2, 3), keepdim=True, correction=0)
        return (x - mean) / torch.sqrt(variance + 1e-5)
    mean, variance, gain, bias = (
        state[f"{name}.{key}"][None, :, None, None]
        for key in ("running_mean", "running_var", "weight", "bias")
    )
    return (x - mean) / torch.sqrt(variance + 1e-5) * gain + bias


def encoder(state: State, x: Tensor) -> Tensor:
    x = norm(state, "norm1", conv(state, "conv1", x, 2)).relu()
    for layer in (1, 2, 3):
        for block in (0, 1):
            s = part(state, f"layer{layer}.{block}")
            stride = 2 if layer > 1 and block == 0 else 1
            y = norm(s, "norm1", conv(s, "conv1", x, stride)).relu()
            y = norm(s, "norm2", conv(s, "conv2", y)).relu()
            if stride == 2:
                x = norm(s, "norm3", conv(s, "downsample.0", x, 2))
            x = (x + y).relu()
    return conv(state, "conv2", x)


def lookup(lidar: Tensor, image: Tensor, positions: Tensor) -> Tensor:
    batch, channels, height, width = lidar.shape
    volume = torch.einsum("bcij,bckl->bijkl", lidar, image) / channels**0.5
    level = volume.reshape(-1, 1, *image.shape[2:])
    found = []
    for n in range(4):
        rows, columns = level.shape[2:]
        for ox in range(-4, 5):
            for oy in range(-4, 5):
                x = positions[:, 0].reshape(-1) / 2**n + ox
                y = positions[:, 1].reshape(-1) / 2**n + oy
                grid = torch.stack([2 * x / (columns - 1) - 1, 2 * y / (rows - 1) - 1], dim=-1)
                sampled = F.grid_sample(level, grid[:, None, None], align_corners=True)
                found.append(sampled.reshape(batch, height, width))
        level = F.avg_pool2d(level, 2)
    return torch.stack(found, dim=1)


def update(s: State, h: Tensor, context: Tensor, corr: Tensor, flow: Tensor) -> Tensor:
    a = conv(s, "encoder.convc2", conv(s, "encoder.convc1", corr).relu()).relu()
    b = conv(s, "encoder.convf2", conv(s, "encoder.convf1", flow).relu()).relu()
    m = conv(s, "encoder.conv", torch.cat([a, b], 1)).relu()
    x = torch.cat([context, m, flow], 1)
    for k in "12":
        z = conv(s, f"gru.convz{k}", torch.cat([h, x], 1)).sigmoid()
        r = conv(s, f"gru.convr{k}", torch.cat([h, x], 1)).sigmoid()
        q = conv(s, f"gru.convq{k}", torch.cat([r * h, x], 1)).tanh()
        h = (1 - z) * h + z * q
    return h


def head(s: State, h: Tensor) -> Tensor:
    return conv(s, "flow_head.conv2", conv(s, "flow_head.conv1", h).relu())


def upsampled(s: State, h: Tensor, values: Tensor) -> Tensor:
    mask = 0.25 * conv(s, "mask.2", conv(s, "mask.0", h).relu())
    batch, channels, height, width = values.shape
    weights = mask.reshape(batch, 9, 64, height, width).softmax(dim=1)
    padded = F.pad(values, (1, 1, 1, 1))
    out = torch.zeros(batch, channels, 8 * height, 8 * width)
    for sy in range(8):
        for sx in range(8):
            for n in range(9):
                dy, dx = divmod(n, 3)
                neighbour = padded[:, :, dy : dy + height, dx : dx + width]
                out[:, :, sy::8, sx::8] += weights[:, n, None, 8 * sy + sx] * neighbour
    return out


def flow_of(state: State, rgb: Tensor, lidar: Tensor, *, context: str, iterations: int) -> Tensor:
    f_lidar, f_image = (
        encoder(part(state, "fnet_lidar"), lidar),
        encoder(part(state, "fnet_img"), rgb),
    )
    raw = encoder(part(state, "cnet"), lidar if context == "lidar" else rgb)
    h, c = raw.chunk(2, dim=1)
    h, c = h.tanh(), c.relu()
    s = part(state, "update_block")
    rows, columns = torch.meshgrid(
        torch.arange(h.shape[2]), torch.arange(h.shape[3]), indexing="ij"
    )
    grid = torch.stack([columns, rows])[None].float().expand(len(h), -1, -1, -1)
    flow = torch.zeros_like(grid)
    for _ in range(iterations):
        corr = lookup(f_lidar, f_image, grid + flow)
        h = update(s, h, c, corr, flow)
        flow = flow + head(s, h)
    return upsampled(s, h, 8 * flow)
