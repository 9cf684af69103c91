"""Files: YAML that is no plain mapping, sets that are written together, errors in words."""

import errno
import re
import time
import tokenize
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from calibgraph import FileError, files, load_rig
from calibgraph.errors import in_words, printable
from calibgraph.files import read_yaml, write_atomically, write_text, written_together
from calibgraph.yaml_text import parse_yaml
from tests.conftest import SAMPLE

ALIASES = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
ALIASES += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
MERGES = ["a0: &a0 {x: 1}"]
MERGES += [f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}" for i in range(1, 26)]
LARGE = "a0: &a0 {" + ", ".join(f"k{k}: {k}" for k in range(3000)) + "}"
REFUSED = {
    **dict.fromkeys(("", "- a\n- b\n", "{unclosed", "\x00\x01", "just words", "&a [*a]"), "."),
    **dict.fromkeys(("a: 2020-13-45", "a: !!int abc", "a: !!int ''"), "not valid YAML"),
    "a: " + "9" * 5000: "not valid YAML",
    "[" * 20_000: "not valid YAML|too deeply",
    "{a: " * 1000: "not valid YAML|too deeply",
    "a: " + "[" * 40_000 + "]" * 40_000: "too deeply",  # the parser would end the process
    "\n".join([*ALIASES, "cameras: {a: {T_camera_lidar: *a11}}"]): "aliases stand for over",
    "\n".join(MERGES): "merge keys .* stand for over",
    "\n".join([LARGE, "all:", *["- {<<: *a0}"] * 1000]): "merge keys .* stand for over",
}


@pytest.mark.parametrize(("text", "message"), REFUSED.items(), ids=range(len(REFUSED)))
def test_what_is_no_mapping_or_a_bomb_is_refused_at_once(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(FileError, match=message) as caught:
        load_rig(path)
    assert time.process_time() - begin < 10  # written out, merge keys take over a minute
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_full_disk_is_named_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "written.yaml"

    def fail(_: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="cannot be written .No space left on device.*free") as caught:
        write_atomically(path, fail)
    assert caught.value.filename == str(path)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("value", "said"),
    [
        *((n, f"Input should be a valid .*, found '{n}'$") for n in ("0x10", "-0x10", "0b11")),
        *((word, "expected no truth value") for word in ("true", "false")),
    ],
)
def test_truth_values_and_numbers_of_another_base_are_refused_as_values(
    value: str, said: str, tmp_path: Path
) -> None:
    path, text = tmp_path / "rig.yaml", (SAMPLE / "rig.yaml").read_text()
    for pattern in (r"(fx: )[0-9.]+", r"(width_px: )[0-9]+", r"(distortion: \[)"):
        changed, count = re.subn(pattern, rf"\g<1>{value}", text, count=1)
        path.write_text(changed)
        with pytest.raises(FileError, match=said):
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
    [("lidar: a\n".encode("utf-16"), "is not a text file in UTF-8"),
     ("lidar: a\n# Prüfstand\n".encode("latin-1"), "is not UTF-8: line 2 holds the byte 0xfc"),
     (b"\xff\0\x01\x02", "is not a text file in UTF-8"),
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


NAMES = ("a.txt", "calibration.yaml", "z.txt")
LAST = "calibration.yaml"


def write_all(folder: Path, text: str) -> None:
    with written_together(folder, last=LAST) as new:
        for name in reversed(NAMES):
            write_text(new / name, text)


def texts(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_files_that_are_written_together_appear_together_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = list[Path]()
    monkeypatch.setattr(files, "sync_to_disk", synced.append)
    old = tmp_path / "a.txt"
    old.write_text("old")
    full = OSError(errno.ENOSPC, "No space left on device")
    with (
        pytest.raises(OSError, match="No space") as caught,
        written_together(tmp_path, last=LAST) as new,
    ):
        write_text(new / "a.txt", "new")
        full.filename = str(new / "lidar" / "b.npy")
        raise full
    assert caught.value.filename == str(tmp_path / "lidar" / "b.npy")
    assert ([*tmp_path.iterdir()], old.read_text()) == ([old], "old")
    write_all(tmp_path, "new")
    assert {path.name for path in synced} >= {*NAMES} and synced[-1] == tmp_path, "the renames"
    assert texts(tmp_path) == dict.fromkeys(NAMES, "new")
    assert len([*tmp_path.iterdir()]) == len(NAMES)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2J", "\\x1b[2J"),
        ("a\x7fb\x9b2J", "a\\x7fb\\x9b2J"),
        ("rig\u202elmay.gir", "rig\\u202elmay.gir"),
        ("a\rb\u2028c\ud800", "a\\rb\\u2028c\\ud800"),
        ("Kamera größer\n\tü 前 שלום", "Kamera größer\n\tü 前 שלום"),
    ],
)
def test_characters_that_are_not_seen_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(), MemoryError((2, 3)), tokenize.TokenError("EOF in multi-line", (1, 0)),
        SyntaxError("x", ("<unknown>", 1, 1, "", 1, 1)), KeyError("descr"), RecursionError(),
        AttributeError("'NoneType' object has no attribute 'x'"), AssertionError(), EOFError(),
        ValueError(), ValueError("no header"), OSError(5, "Input/output error"),
        zipfile.BadZipFile("no zip"),
    ],
)  # fmt: skip
def test_errors_of_libraries_are_put_in_words(error: Exception) -> None:
    words = in_words(error)
    assert words
    assert type(error).__name__ not in words
    assert not set("()'<>") & set(words)
