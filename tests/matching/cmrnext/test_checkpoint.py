"""Weights from files: good ones are read whole, bad ones refused in a line, none executed."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from calibgraph import FileError
from calibgraph.matching.cmrnext import load_checkpoint
from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.network import CmrNext
from calibgraph.matching.cmrnext.pickle_reader import read_checkpoint
from tests.conftest import Call

CONFIG = {
    "use_reflectance": False,
    "normalize_images": True,
    "max_depth": 160.0,
    "upsample_method": "transposed",
    "fourier_levels": 12,
    "context_encoder": "lidar",
    "uncertainty": False,
    "max_r": 1.0,
    "max_t": 0.1,
}


def good_content(architecture: Architecture | None = None) -> dict[str, Any]:
    torch.manual_seed(0)
    state = CmrNext(architecture or Architecture(width=8)).state_dict()
    return {"config": dict(CONFIG), "epoch": 150, "state_dict": state, "train_loss": 0.5}


def saved(path: Path, content: Any) -> Path:
    torch.save(content, path)
    return path


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


def test_weights_survive_conversion_to_safetensors(tmp_path: Path) -> None:
    original = load_checkpoint(saved(tmp_path / "iter1.tar", good_content()))
    original.save_safetensors(tmp_path / "iter1.safetensors")
    converted = load_checkpoint(tmp_path / "iter1.safetensors")
    assert converted.config == original.config
    assert converted.architecture == original.architecture
    for name, tensor in original.state.items():
        assert torch.equal(converted.state[name], tensor), name


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


class Mapping(dict[str, Any]):
    """A mapping of a class that the reader does not know, as some trainers wrote."""


def test_foreign_objects_beside_the_weights_do_no_harm(tmp_path: Path) -> None:
    content = good_content()
    content |= {
        "train_epe": np.float64(1.5),
        "arguments": Mapping(a=1),
        "order": OrderedDict(a=2),
        "path": Path("/tmp"),
        "device": torch.device("cpu"),
    }
    path = saved(tmp_path / "a.tar", content)
    load_checkpoint(path)
    read = read_checkpoint(path)
    assert read["train_epe"] == 1.5
    assert read["order"] == {"a": 2}


class Command:
    """Runs a command when it is unpickled, if it is let."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


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


def repacked(path: Path, replacements: dict[str, bytes], compress: bool = False) -> None:
    """Write a good checkpoint with some entries of its zip replaced."""
    buffer = io.BytesIO()
    torch.save(good_content(), buffer)
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(path, "w", kind) as new:
        for entry in old.infolist():
            name = entry.filename.split("/", 1)[1]
            new.writestr(entry.filename, replacements.get(name, old.read(entry)))


def tensor_pickle(size: tuple[int, ...], stride: tuple[int, ...], count: int) -> bytes:
    """A pickle of {config, state_dict} whose tensor claims a size."""

    class Storage:
        pass

    class Claim:
        def __reduce__(self) -> tuple[Any, ...]:
            rebuild = torch._utils._rebuild_tensor_v2
            return rebuild, (Storage(), 0, size, stride, False, OrderedDict())

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            if isinstance(obj, Storage):
                return ("storage", torch.FloatStorage, "0", "cpu", count)
            return None

    out = io.BytesIO()
    Pickler(out, 2).dump({"config": CONFIG, "state_dict": {"fnet_lidar.conv1.weight": Claim()}})
    return out.getvalue()


def pickled_command(path: Path) -> None:
    path.write_bytes(pickle.dumps(Command(path.parent / "executed")))


def zipped_command(path: Path) -> None:
    torch.save(Command(path.parent / "executed"), path)


def command_beside_weights(path: Path) -> None:
    torch.save(good_content()["config"] | {"state_dict": Command(path.parent / "executed")}, path)


def truncated(path: Path) -> None:
    torch.save(good_content(), path)
    path.write_bytes(path.read_bytes()[:-5000])


def claim_of_10_gb(path: Path) -> None:
    big = (2_500_000_000,)
    repacked(path, {"data.pkl": tensor_pickle(big, (1,), count=16)})


def claim_by_repetition(path: Path) -> None:
    """A tensor of 10 GB that repeats one number: its strides are zero."""
    repacked(path, {"data.pkl": tensor_pickle((2_500_000_000,), (0,), count=2)})


def zip_entry_of_10_gb(path: Path) -> None:
    torch.save(good_content(), path)
    data = bytearray(path.read_bytes())
    directory = data.rindex(b"PK\x01\x02")  # the last entry of the central directory
    data[directory + 20 : directory + 28] = struct.pack("<II", 2**32 - 2, 2**32 - 2)
    path.write_bytes(data)


def huge_memo(path: Path) -> None:
    """A pickle that puts one value at place 2^31 - 1 of its memo."""
    repacked(path, {"data.pkl": b"\x80\x02Nr\xff\xff\xff\x7f."})


def nested(path: Path) -> None:
    repacked(path, {"data.pkl": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."})


def zeros_packed(path: Path) -> None:
    repacked(path, {"data/0": bytes(2**24)}, compress=True)


def safetensors(config: str | None, length: int | None = None) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        metadata = {} if config is None else {"__metadata__": {"config": config}}
        header = json.dumps(metadata).encode()
        path.write_bytes(struct.pack("<Q", length or len(header)) + header)

    return write


def program(body: bytes) -> Callable[[Path], None]:
    """A zip whose pickle is this, and nothing else."""

    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", body)

    return write


def flagged(path: Path) -> None:
    """A good checkpoint that says it is encrypted."""
    torch.save(good_content(), path)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)


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


def negated(path: Path) -> None:
    content = good_content()
    negative = torch._neg_view(torch.ones(32))
    content["state_dict"]["cnet.conv2.bias"] = negative
    torch.save(content, path)


def nan_weight() -> torch.Tensor:
    bias = torch.zeros(32)
    bias[3] = torch.nan
    return bias


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "a pickle that runs a command": (pickled_command, "not a checkpoint"),
    "a zip whose pickle runs a command": (zipped_command, "expected a checkpoint"),
    "a command in place of weights": (command_beside_weights, "lacks 'config'"),
    "truncated": (truncated, "damaged"),
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
    "a tensor that claims 10 GB": (claim_of_10_gb, "storage"),
    "a tensor of 10 GB from 2 numbers": (claim_by_repetition, "storage"),
    "a zip entry that claims 4 GB": (zip_entry_of_10_gb, "claim|damaged"),
    "a memo of 2^31 places": (huge_memo, "no mapping"),
    "100,000 nested lists": (nested, "no mapping"),
    "packed zeros": (zeros_packed, "packed"),
    "copies that differ": (
        changed_weights(**{"cnet.layer2.0.norm3.bias": torch.ones(12)}), "differ",
    ),
    "no config": (with_weights(lambda c: c.pop("config")), "lacks 'config'"),
    "no depth scale": (with_weights(lambda c: c["config"].pop("max_depth")), "max_depth"),
    "a depth scale of zero": (changed_config(max_depth=0), "max_depth"),
    "another encoding than it says": (changed_config(fourier_levels=8), "fourier_levels = 8"),
    "another context than it says": (changed_config(context_encoder="rgb"), "context_encoder"),
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
    "a key that is nested a million times": (
        program(b"\x80\x02}N" + b"\x85" * 900_000 + b"Ns."), "neither text nor",
    ),
    "a key that takes 2^60 steps to hash": (
        program(b"\x80\x02}N" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(60)) + b"Ns."),
        "neither text nor",
    ),
    "a reference of 2^60 parts": (
        program(b"\x80\x02N" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(60)) + b"Q."),
        "no storage",
    ),
    "bytes that claim 2 GB": (
        program(b"\x80\x05\x96" + struct.pack("<Q", 2 * 10**9) + b"x."), "expected",
    ),
    "eight million instructions": (program(b"\x80\x04(" + b"\x8f" * 8_000_000), "instructions"),
    "an instruction cut short": (program(b"\x80\x02r\x00"), "not enough data"),
    "changed functions": (
        program(b"\x80\x02c_codecs\nencode\nN}X\x0c\0\0\0__defaults__X\1\0\0\0x\x85s\x86b."),
        "no mapping",
    ),
    "a storage of invented numbers": (
        program(b"\x80\x02(X\7\0\0\0storageX\4\0\0\0<f16X\1\0\0\0" + b"0NK\1tQ."),
        "not supported",
    ),
    "encryption": (flagged, "encrypted"),
    "overlapping entries": (overlapping, "more bytes than the file has"),
    "a negated view": (negated, "not plain"),
    "numbers without end": (changed_config(max_depth=10**400), "64 bits"),
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
        changed_weights(fnet_img__conv1__weight=torch.zeros(8 * 10**12, 0, 7, 7)), "width|claims",
    ),
    "an empty file": (lambda path: path.write_bytes(b"") and None, "not a checkpoint"),
    "text": (lambda path: path.write_text("weights") and None, "not a checkpoint"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    write, message = BAD[name]
    path = tmp_path / "iter1.tar"
    write(path)
    with pytest.raises(FileError, match="|".join(map(_escaped, message.split("|")))) as caught:
        load_checkpoint(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text and len(text) < 600
    assert not (tmp_path / "executed").exists()


def _escaped(text: str) -> str:
    return text.replace("(", r"\(").replace(")", r"\)")


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


def test_messages_stay_short_and_printable(tmp_path: Path) -> None:
    evil = "\x1b[31m" + "x" * 500_000
    content = good_content()
    content["state_dict"][evil] = torch.zeros(1)
    with pytest.raises(FileError) as caught:
        load_checkpoint(saved(tmp_path / "a.tar", content))
    assert len(str(caught.value)) < 3000 and str(caught.value).isprintable()
    content = good_content()
    content["config"] |= {"name": "evil\x1b[31m", "note": "fine"}
    assert set(load_checkpoint(saved(tmp_path / "b.tar", content)).config) == {*CONFIG, "note"}


def test_missing_weights_say_where_to_get_them(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"https://cmrnext\S+.*academic use.*calibgraph train"):
        load_checkpoint(tmp_path / "iter1.tar")


def test_the_command_line_refuses_and_converts(tmp_path: Path, call: Call) -> None:
    bad, good = tmp_path / "bad.tar", saved(tmp_path / "good.tar", good_content())
    zipped_command(bad)
    code, _, line = call("weights", bad)
    assert code == 2
    assert line.count("\n") == 1
    assert not (tmp_path / "executed").exists()
    converted = tmp_path / "good.safetensors"
    assert call("weights", good, "--out", converted)[0] == 0
    described = json.loads(call("weights", converted, "--json")[1])
    assert described["network"]["fourier_levels"] == 12
    assert described["config"]["max_r"] == 1.0
