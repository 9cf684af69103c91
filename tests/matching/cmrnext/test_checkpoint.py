"""Files of weights: good ones are read exactly; damaged, hostile and unsound ones are refused."""

import io
import os
import pickle
import re
import resource
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from calibgraph import FileError
from calibgraph.matching.cmrnext import checkpoint as checkpoints
from calibgraph.matching.cmrnext import load_checkpoint
from calibgraph.matching.cmrnext.network import Architecture
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
    "no mapping": (lambda path: torch.save([1], path), "no mapping"),
    "no config": (with_weights(lambda c: c.pop("config")), "lacks 'config'"),
    "a state dict of texts": (
        with_weights(lambda c: c.update(state_dict={"a": "b"})), "no tensor",
    ),
    "no depth scale": (with_weights(lambda c: c["config"].pop("max_depth")), "max_depth"),
    "a depth scale of zero": (changed_config(max_depth=0), "max_depth"),
    "another encoding than in its config": (changed_config(fourier_levels=8), "fourier_levels 8"),
    "another context than in its config": (
        changed_config(context_encoder="rgb"), "context rgb",
    ),
    "an uncertainty head": (changed_config(uncertainty=True), "uncertainty: "),
    "reflectance that is not there": (changed_config(use_reflectance=True), "reflectance True"),
    "flow of the other sign": (changed_config(al_contrario=True), "al_contrario"),
    "an evidential head": (
        changed_weights(update_block__flow_head__conv2__weight=torch.zeros(8, 32, 3, 3)),
        "has shape (8, 32, 3, 3)",
    ),
    "weights of another network": (
        with_weights(lambda c: c.update(state_dict={"a": torch.zeros(1)})), "not the weights",
    ),
    "numbers without end": (changed_config(max_depth=10**400), "max_depth"),
    "a depth scale that is true": (changed_config(max_depth=True), "max_depth"),
    "a range that is text": (changed_config(max_r="x"), "max_r"),
    "whole numbers for weights": (
        changed_weights(cnet__conv2__bias=torch.ones(32, dtype=torch.int8)), "numbers of type",
    ),
    "an enormous network": (
        changed_weights(fnet_img__conv1__weight=torch.zeros(8 * 10**12, 0, 7, 7)), "network width",
    ),
}  # fmt: skip


def test_wrapped_half_and_strided_weights_are_read(tmp_path: Path) -> None:
    """A `module.` prefix, other float types, and tensors that are views of larger storages."""
    content = good_content()
    state = {f"module.{name}": tensor for name, tensor in content["state_dict"].items()}
    name = "module.fnet_img.conv2.weight"
    expected = state[name].clone()
    state[name] = state[name].double()
    backwards = state["module.fnet_img.conv1.bias"]
    larger = torch.zeros(2 * len(backwards))
    larger[::2] = backwards
    state["module.fnet_img.conv1.bias"] = larger[::2]
    checkpoint = load_checkpoint(saved(tmp_path / "a.tar", content | {"state_dict": state}))
    assert torch.equal(checkpoint.state["fnet_img.conv2.weight"], expected)
    assert torch.equal(checkpoint.state["fnet_img.conv1.bias"], backwards)


def test_sizes_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path / "a.tar", good_content())
    monkeypatch.setattr(checkpoints, "MAX_BYTES", 50)
    with pytest.raises(FileError, match="bytes, expected at most"):
        load_checkpoint(path)


class Command:
    """Runs a command when it is unpickled, if it is let."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


def repacked(path: Path, replacements: dict[str, bytes], compress: bool = False) -> None:
    """Write a good checkpoint with some entries of its zip replaced."""
    buffer = io.BytesIO()
    torch.save(good_content(), buffer)
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(path, "w", kind) as new:
        for entry in old.infolist():
            name = entry.filename.split("/", 1)[1]
            new.writestr(entry.filename, replacements.get(name, old.read(entry)))


def pickled_command(path: Path) -> None:
    path.write_bytes(pickle.dumps(Command(path.parent / "executed")))


def zipped_command(path: Path) -> None:
    torch.save(Command(path.parent / "executed"), path)


def command_beside_weights(path: Path) -> None:
    torch.save(good_content()["config"] | {"state_dict": Command(path.parent / "executed")}, path)


def truncated(path: Path) -> None:
    torch.save(good_content(), path)
    path.write_bytes(path.read_bytes()[:-5000])


def zeros_packed(path: Path) -> None:
    repacked(path, {"data/0": bytes(2**24)}, compress=True)


def overlapping(path: Path) -> None:
    """Entries that all claim the same bytes."""
    torch.save(good_content(), path)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        start = archive.start_dir
    data = path.read_bytes()
    size = len(data) // 2
    head = data[:start]
    directory = b"".join(
        struct.pack("<IHHHHHHIIIHHHHHII", 0x02014B50, 20, 20, 0, 0, 0, 0, 0, size, size, 9,
                    0, 0, 0, 0, 0, 0) + b"a/data/%02d" % i
        for i in range(30)
    )  # fmt: skip
    end = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 30, 30, len(directory), start, 0)
    assert len(entries) > 30
    path.write_bytes(head + directory + end)


HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "a pickle that runs a command": (pickled_command, "not a checkpoint"),
    "a zip whose pickle runs a command": (zipped_command, "posix is blocked"),
    "a command in place of weights": (command_beside_weights, "posix is blocked"),
    "truncated": (truncated, "damaged"),
    "packed zeros": (zeros_packed, "packed"),
    "overlapping entries": (overlapping, "more bytes than the file has"),
    "an empty file": (lambda path: path.write_bytes(b"") and None, "not a checkpoint"),
}  # fmt: skip


REFUSED = {name: (write, re.escape(said)) for name, (write, said) in (BAD | HOSTILE).items()}


@pytest.mark.parametrize("name", REFUSED)
def test_unsound_and_hostile_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    write, message = REFUSED[name]
    path = tmp_path / "iter1.tar"
    write(path)
    start, memory_kb = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileError, match=message) as caught:
        load_checkpoint(path)
    # The files have at most 8 MB; they claim up to 10 GB.
    assert time.process_time() - start < 60
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb < 500_000
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text and len(text) < 600
    assert not (tmp_path / "executed").exists()
