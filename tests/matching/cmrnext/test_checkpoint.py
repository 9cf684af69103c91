"""Checkpoints: weights and config are read exactly, and refused in a line if they disagree."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from calibgraph import FileError
from calibgraph.matching.cmrnext import load_checkpoint
from calibgraph.matching.cmrnext.architecture import Architecture
from tests.matching.cmrnext.builders import CONFIG, good_content, saved


def test_weights_are_read_exactly(tmp_path: Path) -> None:
    content = good_content()
    checkpoint = load_checkpoint(saved(tmp_path / "iter1.tar", content))
    assert checkpoint.architecture == Architecture(width=8)
    assert checkpoint.config == CONFIG
    assert checkpoint.range_deg_m == (1.0, 0.1)
    assert len(checkpoint.sha256) == 64
    for name, tensor in content["state_dict"].items():
        assert torch.equal(checkpoint.state[name], tensor), name
    model = checkpoint.network()
    assert not model.training


def with_weights(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        content = good_content()
        change(content)
        torch.save(content, path)

    return write


def changed_config(**changes: Any) -> Callable[[Path], None]:
    return with_weights(lambda content: content["config"].update(changes))


def changed_weights(**changes: torch.Tensor) -> Callable[[Path], None]:
    named = {name.replace("__", "."): tensor for name, tensor in changes.items()}
    return with_weights(lambda content: content["state_dict"].update(named))


def nan_weight() -> torch.Tensor:
    bias = torch.zeros(32)
    bias[3] = torch.nan
    return bias


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "a wrong shape": (changed_weights(cnet__conv2__bias=torch.zeros(33)), "has shape (33,)"),
    "missing weights": (
        with_weights(lambda c: c["state_dict"].pop("update_block.mask.0.bias")),
        "lacks weights 'update_block.mask.0.bias'",
    ),
    "unknown weights": (changed_weights(surplus=torch.zeros(1)), "unknown weights 'surplus'"),
    "NaN weights": (changed_weights(cnet__conv2__bias=nan_weight()), "not finite"),
    "weights too large for a float32": (
        changed_weights(cnet__conv2__bias=torch.full((32,), 1e300, dtype=torch.float64)),
        "not finite",
    ),
    "negative variances": (
        changed_weights(cnet__norm1__running_var=-torch.ones(8)), "variances below zero",
    ),
    "copies that differ": (
        changed_weights(**{"cnet.layer2.0.norm3.bias": torch.ones(12)}), "differ",
    ),
    "no mapping": (lambda path: torch.save([1], path), "no mapping"),
    "no config": (with_weights(lambda c: c.pop("config")), "lacks 'config'"),
    "a state dict of texts": (
        with_weights(lambda c: c.update(state_dict={"a": "b"})), "no tensor",
    ),
    "no depth scale": (with_weights(lambda c: c["config"].pop("max_depth")), "max_depth"),
    "a depth scale of zero": (changed_config(max_depth=0), "max_depth"),
    "another encoding than in its config": (changed_config(fourier_levels=8), "fourier_levels = 8"),
    "another context than in its config": (
        changed_config(context_encoder="rgb"), "context_encoder",
    ),
    "uncertainty that is not there": (changed_config(uncertainty=True), "uncertainty"),
    "reflectance that is not there": (changed_config(use_reflectance=True), "use_reflectance"),
    "flow of the other sign": (changed_config(al_contrario=True), "al_contrario"),
    "an evidential head": (
        changed_weights(update_block__flow_head__conv2__weight=torch.zeros(8, 32, 3, 3)),
        "evidential",
    ),
    "weights of another network": (
        with_weights(lambda c: c.update(state_dict={"a": torch.zeros(1)})), "not the weights",
    ),
    "numbers without end": (changed_config(max_depth=10**400), "max_depth"),
    "a depth scale that is true": (changed_config(max_depth=True), "max_depth"),
    "a range that is text": (changed_config(max_r="x"), "max_r"),
    "an error bar that is text": (
        changed_config(systematic_rotation_rad="abc"), "systematic_rotation_rad",
    ),
    "a resolution that is text": (changed_config(half_resolution="yes"), "half_resolution"),
    "whole numbers for weights": (
        changed_weights(cnet__conv2__bias=torch.ones(32, dtype=torch.int8)), "numbers of type",
    ),
    "an enormous network": (
        changed_weights(fnet_img__conv1__weight=torch.zeros(8 * 10**12, 0, 7, 7)), "network width",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_unsound_checkpoints_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    write, message = BAD[name]
    path = tmp_path / "iter1.tar"
    write(path)
    with pytest.raises(FileError, match=re.escape(message)) as caught:
        load_checkpoint(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text and len(text) < 600


def safetensors(config: str | None, length: int | None = None) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        metadata = {} if config is None else {"__metadata__": {"config": config}}
        header = json.dumps(metadata).encode()
        path.write_bytes(struct.pack("<Q", length or len(header)) + header)

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (safetensors(None), "no config"),
        (safetensors("[1]"), "no config"),
        (safetensors("{"), "cannot be read"),
        (safetensors("{}", 10 * 2**30), "cannot be read"),
        (safetensors("{}"), "max_depth"),
    ],
)
def test_bad_safetensors_are_refused(
    tmp_path: Path, write: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "a.safetensors"
    write(path)
    with pytest.raises(FileError, match=message):
        load_checkpoint(path)


def test_bfloat16_safetensors_are_read(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    content = good_content()
    state = {k: (v.bfloat16() if v.is_floating_point() else v.clone()).contiguous()
             for k, v in content["state_dict"].items()}  # fmt: skip
    path = tmp_path / "a.safetensors"
    save_file(state, path, {"config": json.dumps(content["config"])})
    checkpoint = load_checkpoint(path)
    torch.testing.assert_close(
        checkpoint.state["cnet.conv2.bias"], content["state_dict"]["cnet.conv2.bias"],
        atol=0, rtol=2**-8,
    )  # fmt: skip
