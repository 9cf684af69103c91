"""Files that replace older ones together: after an error or a kill no set is mixed unnoticed."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest

from calibgraph.file_sets import written_together
from calibgraph.files import write_text

NAMES = ("a.txt", "calibration.yaml", "z.txt")
LAST = "calibration.yaml"


def write_all(folder: Path, text: str) -> None:
    with written_together(folder, last=LAST) as new:
        for name in reversed(NAMES):
            write_text(new / name, text)


def texts(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_files_that_are_written_together_appear_together_or_not_at_all(tmp_path: Path) -> None:
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
    assert texts(tmp_path) == dict.fromkeys(NAMES, "new")
    assert len([*tmp_path.iterdir()]) == len(NAMES)


def test_two_sets_are_not_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one waits while the files of the first are moved."""
    replace, moved = Path.replace, list[Path]()
    second = Thread(target=write_all, args=(tmp_path, "second"))

    def move(path: Path, target: Path) -> Path:
        if target.parent == tmp_path:
            moved.append(target)
            if len(moved) == 2:
                second.start()
                second.join(0.3)
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", move)
    write_all(tmp_path, "first")
    second.join()
    assert texts(tmp_path) == dict.fromkeys(NAMES, "second")


def watch_moves(
    monkeypatch: pytest.MonkeyPatch, folder: Path, fails: int = 0, number: int = errno.EPERM
) -> list[Path]:
    """The files that are moved into a folder, the order kept; one of them fails."""
    moved: list[Path] = []
    replace = Path.replace

    def watched(path: Path, target: Path) -> Path:
        if target.parent == folder and target not in moved:
            moved.append(target)
            if len(moved) == fails:
                raise OSError(number, "not permitted", str(path))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", watched)
    return moved


@pytest.mark.parametrize("fails", [1, 2, 3])
@pytest.mark.parametrize("has_links", [True, False])
def test_an_error_between_the_moves_leaves_what_was_there(
    fails: int, has_links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {"a.txt": "old", LAST: "old"}
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    if not has_links:
        monkeypatch.setattr("os.link", lambda *_, **__: refuse())
    moved = watch_moves(monkeypatch, tmp_path, fails)
    with pytest.raises(OSError, match="cannot be written .*; choose another folder") as caught:
        write_all(tmp_path, "new")
    assert caught.value.filename == str(moved[fails - 1])
    assert texts(tmp_path) == before
    assert len([*tmp_path.iterdir()]) == len(before)


def refuse() -> None:
    raise OSError(errno.EPERM, "no hard links")


KILLED = """
import os, signal, sys
from pathlib import Path
from calibgraph.file_sets import written_together
with written_together(Path(sys.argv[1]), last="a.txt") as new:
    (new / "a.txt").write_text("half")
    (new / "lidar").mkdir()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_is_removed_but_nothing_of_a_living_one(tmp_path: Path) -> None:
    (tmp_path / ".writing-notes").write_text("mine")
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert len([*tmp_path.glob(".writing-*/lidar")]) == 1
    with written_together(tmp_path, last=LAST) as living:
        assert [path.parent for path in tmp_path.glob(".writing-*")] == [tmp_path] * 2
        assert not [*tmp_path.glob(".writing-*/lidar")]
        write_text(living / "b.txt", "living")
        write_all(tmp_path, "other")
        assert (living / "b.txt").read_text() == "living"
    assert texts(tmp_path) == dict.fromkeys(NAMES, "other") | {
        "b.txt": "living", ".writing-notes": "mine"
    }  # fmt: skip
