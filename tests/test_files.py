"""YAML files: what is no plain mapping is refused in one line."""

from __future__ import annotations

import errno
import re
import time
import tracemalloc
from pathlib import Path

import pytest

from calibgraph import (
    FileError,
    Rig,
    load_rig,
)
from calibgraph.files import (
    read_yaml,
    write_atomically,
    write_yaml,
)
from calibgraph.yaml_text import parse_yaml
from tests.conftest import SAMPLE
from tests.model.test_rig import written


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "{unclosed", "\x00\x01", "just words"])
def test_what_is_not_a_mapping_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=str(path)):
        load_rig(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 2020-13-45", "not valid YAML"),
        ("a: !!int abc", "not valid YAML"),
        ("a: !!int ''", "not valid YAML"),
        ("a: " + "9" * 5000, "not valid YAML"),
        ("[" * 20_000, "not valid YAML|too deeply"),
        ("{a: " * 1000, "not valid YAML|too deeply"),
        ("a: " + "[" * 40_000 + "]" * 40_000, "too deeply"),  # the parser would end the process
        ("&a [*a]", "."),
    ],
)
def test_what_the_yaml_parser_chokes_on_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        load_rig(path)
    assert "\n" not in str(caught.value)


def test_an_alias_bomb_is_refused_at_once(tmp_path: Path) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    path = tmp_path / "rig.yaml"
    path.write_text("\n".join([*lines, "cameras: {a: {T_camera_lidar: *a11}}"]))
    with pytest.raises(FileError, match="aliases stand for over"):
        load_rig(path)


def merge_bombs() -> dict[str, str]:
    """YAML files whose merge keys multiply: by aliases of aliases, or of one large mapping."""
    doubled = [f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}" for i in range(1, 26)]
    large = "a0: &a0 {" + ", ".join(f"k{k}: {k}" for k in range(3000)) + "}"
    return {
        "of aliases": "\n".join(["a0: &a0 {x: 1}", *doubled]),
        "of a large mapping": "\n".join([large, "all:", *["- {<<: *a0}"] * 1000]),
    }


@pytest.mark.parametrize("kind", merge_bombs())
def test_a_merge_key_bomb_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(merge_bombs()[kind])
    begin = time.process_time()
    with pytest.raises(FileError, match="merge keys .* stand for over") as caught:
        load_rig(path)
    assert time.process_time() - begin < 10  # written out it takes over a minute
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [{"fx": True}, {"cx": False}])
def test_truth_values_are_no_numbers(wrong: dict[str, bool], pair: Rig, tmp_path: Path) -> None:
    path = written(pair, tmp_path)
    content = read_yaml(path)
    content["cameras"]["left"]["intrinsics_px"] |= wrong
    write_yaml(path, content)
    with pytest.raises(FileError, match=r"cameras.left.intrinsics_px.*expected no truth value"):
        load_rig(path)


def test_a_full_disk_is_named_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "written.yaml"

    def fail(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="cannot be written .No space left on device.*free") as caught:
        write_atomically(path, fail)
    assert caught.value.filename == str(path)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("number", ["0x10", "-0x10", "0b11"])
def test_numbers_of_another_base_are_refused_as_values(number: str, tmp_path: Path) -> None:
    path, text = tmp_path / "rig.yaml", (SAMPLE / "rig.yaml").read_text()
    for pattern in (r"(fx: )[0-9.]+", r"(width_px: )[0-9]+", r"(distortion: \[)"):
        changed, count = re.subn(pattern, rf"\g<1>{number}", text, count=1)
        path.write_text(changed)
        with pytest.raises(FileError, match=f"Input should be a valid .*, found '{number}'$"):
            load_rig(path)
        assert count == 1


@pytest.mark.parametrize(
    "text",
    ["a: [" + "1," * 2_500_000 + "1]", "a:\n" + "- 1\n" * 1_000_000, "b: 1\n" * 600_000,
     "{" + "a: 1, " * 600_000 + "}", "a: " + "- " * 600_000],
    ids=["flow", "block", "keys", "mapping", "lists in lists"],
)  # fmt: skip
def test_a_file_of_millions_of_values_is_refused_before_they_are_made(text: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(FileError, match="expected up to 500000; is it a table"):
            parse_yaml(text, "rig.yaml")
        assert tracemalloc.get_traced_memory()[1] < 10 * len(text)
    finally:
        tracemalloc.stop()


def test_numbers_of_base_60_are_texts() -> None:
    text = "frames: 10:40\nnegative: -1:30.5\nplain: [12, -3, 1.5e-3, 0x10, .inf]\n"
    found = parse_yaml(text, "rig.yaml")
    assert found["frames"] == "10:40"
    assert found["negative"] == "-1:30.5"
    assert found["plain"] == [12, -3, 1.5e-3, "0x10", float("inf")]


@pytest.mark.parametrize(
    ("content", "words"),
    [("lidar: a\n".encode("utf-16"), "is UTF-16, .*; save it as UTF-8"),
     ("lidar: a\n".encode("utf-16-be"), "is UTF-16"),
     ("lidar: a\n".encode("utf-32"), "is UTF-32"),
     ("lidar: a\n# Prüfstand\n".encode("latin-1"), "is not UTF-8: line 2 holds the byte 0xfc"),
     (b"\xff\0\x01\x02", "is not a text file"),
     (b"lens: {fx: 481,3, fy: 480,6}", "3 after a comma has no value: is it a decimal comma"),
     (b"distortion: [-0,31, 0,12]", "looks like decimal commas; write points")],
)  # fmt: skip
def test_texts_as_other_programs_save_them_are_named(
    content: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(content)
    with pytest.raises(FileError, match=words) as caught:
        read_yaml(path)
    assert "\n" not in str(caught.value)
