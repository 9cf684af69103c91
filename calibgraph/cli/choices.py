"""What options stand for: the dataset, the matcher and the settings that a command works with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.cli.support import checked_arguments

if TYPE_CHECKING:
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher
    from calibgraph.model.config import Config


def dataset_of(folders: list[Path], rig: Path | None, frames: str | None) -> Dataset:
    """The dataset of these folders, with that rig instead of its own, and those frames."""
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig

    data = load_dataset(folders, load_rig(rig) if rig else None)
    with checked_arguments():
        return data.select(frames) if frames is not None else data


def matcher_of(
    name: str,
    weights: list[Path] | None,
    *,
    seed: int,
    chosen_frames: bool = False,
    **options: Any,
) -> Matcher:
    """The matcher of that name or file.

    Args:
        name: of the matcher, or a file.
        weights: of cmrnext.
        seed: of everything random.
        chosen_frames: the user chose the frames; then all of them count.
        options: of cmrnext, and the search_deg and search_m of structure; None if not given.

    Raises:
        ValueError: if they do not go together.
    """
    given = {key: value for key, value in options.items() if value is not None}
    searched = {key: _range_option(key, given.pop(key)) for key in _SEARCH if key in given}
    if searched and name != "structure":
        raise ValueError(f"{_flag(next(iter(searched)))} is for --matcher structure only")
    if name == "cmrnext" and weights:
        from calibgraph.matching.cmrnext import CmrNextMatcher

        return CmrNextMatcher(weights, seed=seed, **given)
    for option in ("weights", *(given.keys() - {"device"})):
        if option != "weights" or weights:
            raise ValueError(f"{_flag(option)} is for --matcher cmrnext only")
    if name == "structure":
        from calibgraph.matching.structure import StructureMatcher

        if len(searched) == len(_SEARCH) and len({n is None for n in searched.values()}) > 1:
            raise ValueError("--search-deg and --search-m: give numbers, or none for no search")
        none = dict.fromkeys(_SEARCH) if None in searched.values() else {}
        frames = {"most_frames": None} if chosen_frames else {}
        settings: dict[str, Any] = {**searched, **none, **frames}
        return StructureMatcher(seed=seed, **settings)
    from calibgraph.matching.named import find_matcher

    return find_matcher(name, seed=seed)


_SEARCH = ("search_deg", "search_m")


def _range_option(name: str, text: str) -> float | None:
    """The number that was given, None for ``none``."""
    if text == "none":
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{_flag(name)} {text}: give a number, or none") from None


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def settings_of(
    config: Path | None, preset_name: str | None, seed: int, bootstrap: int | None = None
) -> Config:
    """The settings of a file or of a preset, with what was given besides."""
    from calibgraph.model.config import load_config, preset

    if config is not None and preset_name is not None:
        raise ValueError("--config and --preset exclude each other; put `preset:` into the file")
    settings = load_config(config) if config is not None else preset(preset_name or "auto")
    given = {"seed": seed or None, "bootstrap": bootstrap}
    return settings.changed(**{k: v for k, v in given.items() if v is not None})


def terms_of(name: str) -> Any:
    """The terms of that name, checked."""
    from calibgraph.model.config import TERMS

    if name not in TERMS:
        raise ValueError(f"--terms {name!r}: known are {', '.join(TERMS)}")
    return name
