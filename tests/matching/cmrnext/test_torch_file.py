"""Files of `torch.save`: good ones are read, hostile ones refused in a line, none executed."""

from __future__ import annotations

import io
import os
import pickle
import resource
import struct
import time
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from calibgraph import FileError
from calibgraph.matching.cmrnext import load_checkpoint, torch_file
from tests.matching.cmrnext.builders import CONFIG, good_content, saved

STORAGE_0 = 8 * 3 * 7 * 7
"""Numbers in the first storage of a good checkpoint: its first convolution's weights."""


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
    for limit, message in (("MAX_BYTES", "bytes, expected at most"),):
        monkeypatch.setattr(torch_file, limit, 50)
        with pytest.raises(FileError, match=message):
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


BIG = (2_500_000_000,)


def claim(
    size: tuple[int, ...], stride: tuple[int, ...], count: int = STORAGE_0
) -> Callable[[Path], None]:
    return lambda path: repacked(path, {"data.pkl": tensor_pickle(size, stride, count)})


def pickled_command(path: Path) -> None:
    path.write_bytes(pickle.dumps(Command(path.parent / "executed")))


def zipped_command(path: Path) -> None:
    torch.save(Command(path.parent / "executed"), path)


def command_beside_weights(path: Path) -> None:
    torch.save(good_content()["config"] | {"state_dict": Command(path.parent / "executed")}, path)


def truncated(path: Path) -> None:
    torch.save(good_content(), path)
    path.write_bytes(path.read_bytes()[:-5000])


def zip_entry_of_10_gb(path: Path) -> None:
    torch.save(good_content(), path)
    data = bytearray(path.read_bytes())
    directory = data.rindex(b"PK\x01\x02")  # the last entry of the central directory
    data[directory + 20 : directory + 28] = struct.pack("<II", 2**32 - 2, 2**32 - 2)
    path.write_bytes(data)


def zeros_packed(path: Path) -> None:
    repacked(path, {"data/0": bytes(2**24)}, compress=True)


def program(body: bytes) -> Callable[[Path], None]:
    """A good checkpoint whose pickle is replaced."""
    return lambda path: repacked(path, {"data.pkl": body})


def flagged(path: Path) -> None:
    """A good checkpoint, marked as encrypted."""
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


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "a pickle that runs a command": (pickled_command, "not a checkpoint"),
    "a zip whose pickle runs a command": (zipped_command, "posix is blocked"),
    "a command in place of weights": (command_beside_weights, "posix is blocked"),
    "truncated": (truncated, "damaged"),
    "a tensor that claims 10 GB": (claim(BIG, (1,)), "not resizable"),
    "a tensor that claims its storage to be 10 GB": (
        claim(BIG, (1,), count=BIG[0]), "does not match expected size",
    ),
    "a tensor of 10 GB that repeats one number": (claim(BIG, (0,)), "expected a convolution's"),
    "a tensor of negative strides": (claim((10,), (-1,)), "overflow"),
    "a tensor of 2^124 numbers": (claim((2**62, 2**62), (2**62, 1)), "overflow"),
    "a zip entry that claims 4 GB": (zip_entry_of_10_gb, "claim|damaged"),
    "packed zeros": (zeros_packed, "packed"),
    "encryption": (flagged, "unsupported encryption"),
    "overlapping entries": (overlapping, "more bytes than the file has"),
    "a memo of 2^31 places": (program(b"\x80\x02Nr\xff\xff\xff\x7f."), "no mapping"),
    "100,000 nested lists": (
        program(b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."), "no mapping",
    ),
    "a call of a list": (program(b"\x80\x02])R."), "unrecognized function"),
    "bytes that claim 2 GB": (
        program(b"\x80\x05\x96" + struct.pack("<Q", 2 * 10**9) + b"x."), "Unsupported operand",
    ),
    "an array of 2^52 bytes": (
        program(b"\x80\x02c__builtin__\nbytearray\n\x8a\7\0\0\0\0\0\0\x10\x85R."),
        "more memory than there is",
    ),
    "a tensor made of its size": (
        program(b"\x80\x02ctorch\nFloatTensor\n\x8a\7\0\0\0\0\0\0\x10\x85R."),
        "can't allocate memory",
    ),
    "evaluated code": (
        program(b"\x80\x02c__builtin__\neval\nX\1\0\0\x001\x85R."), "no mapping",
    ),
    "an instruction cut short": (program(b"\x80\x02r\x00"), "ends too early"),
    "a value that was not stored": (program(b"\x80\x02h\x05."), "cannot be read"),
    "a mark in place of a value": (program(b"\x80\x02(Q."), "missing or damaged"),
    "changed functions": (
        program(b"\x80\x02c_codecs\nencode\nN}X\x0c\0\0\0__defaults__X\1\0\0\0x\x85s\x86b."),
        "Can only build",
    ),
    "a storage of invented numbers": (
        program(b"\x80\x02(X\7\0\0\0storageX\4\0\0\0<f16X\1\0\0\0" + b"0NK\1tQ."),
        "a part of it is missing or damaged",
    ),
    "an empty file": (lambda path: path.write_bytes(b"") and None, "not a checkpoint"),
    "text": (lambda path: path.write_text("weights") and None, "not a checkpoint"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_hostile_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    write, message = BAD[name]
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
