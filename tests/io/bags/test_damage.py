"""Damaged bags end in one line that names the bag and what to do."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calibgraph import CalibrationError, FileError, load_dataset, load_rig
from calibgraph.io.clouds import load_cloud
from calibgraph.io.images import load_image
from tests.conftest import SAMPLE
from tests.io.bags.writing import KINDS, sample_bag


def data_file(bag: Path) -> Path:
    return bag if bag.is_file() else next(bag.glob("*.[dm][bc]*"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_truncated_bag_is_named(tmp_path: Path, kind: str, share: float) -> None:
    bag = sample_bag(tmp_path, kind)
    path = data_file(bag)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(FileError, match=r"is truncated, was not closed or is no ROS bag") as caught:
        load_dataset(bag, load_rig(SAMPLE))
    assert str(caught.value).startswith(str(bag))
    assert "or repair it with `" in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_that_are_gone_are_named(tmp_path: Path, kind: str) -> None:
    bag = sample_bag(tmp_path, kind)
    frame = load_dataset(bag).frames[0]
    for name in ("17-0.message", "text.message"):
        with pytest.raises(FileError, match=r"has no message of /points|no such message"):
            load_cloud(frame.cloud_path.with_name(name))
    with pytest.raises(FileError, match="has no message of /elsewhere"):
        load_cloud(bag / "elsewhere" / "17-0.message")
    moved = tmp_path / "moved" / frame.image_paths["left"].relative_to(tmp_path)
    with pytest.raises(FileError, match="no such message: its bag is not there"):
        load_image(moved, load_rig(SAMPLE).cameras["left"])


@pytest.mark.parametrize("library", ["rosbags", "mcap"])
def test_without_a_library_the_command_that_installs_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    bag = sample_bag(tmp_path, "mcap")
    imports: Callable[..., Any] = builtins.__import__

    def without_library(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] == library:
            raise ImportError(f"No module named {name!r}")
        return imports(name, *rest)

    for module in ("mcap_files", "ros1_files"):
        monkeypatch.delitem(sys.modules, f"calibgraph.io.bags.{module}", raising=False)
    monkeypatch.setattr(builtins, "__import__", without_library)
    with pytest.raises(CalibrationError, match=r"needs rosbags and mcap: pip install 'calibgraph"):
        load_rig(bag)
