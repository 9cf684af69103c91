"""Option values to library objects: the dataset, the matcher and the settings of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.cli.terminal import print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.io.bags import BagOptions
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher
    from calibgraph.model.config import Config, Terms

_SEARCH_OPTIONS = ("search_deg", "search_m")


@contextmanager
def checked_arguments() -> Iterator[None]:
    """Turn the library's ``ValueError`` for a wrong argument into a one-line error."""
    from calibgraph.errors import CalibrationError

    try:
        yield
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def dataset_from(
    folders: list[Path],
    rig: Path | None,
    frames: str | None,
    bag: BagOptions | None = None,
    *,
    interval_s: float | None = None,
) -> Dataset:
    """The dataset in these folders; of bags, a line each is printed."""
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig

    with checked_arguments(), progress_bar("reading"):
        known = load_rig(rig) if rig else None
        data = load_dataset(folders, known, frames=frames, bag=bag, interval_s=interval_s)
    for note in data.notes:
        print_plain(terminal(), note)
    return data


def bag_options_from(topic: list[str] | None, **options: Any) -> BagOptions | None:
    """How bags are read; None if no option is given.

    Raises:
        CalibrationError: if a value is out of range, or a topic has no name.
    """
    from calibgraph.io.bags import BagOptions

    given = {name: value for name, value in options.items() if value is not None}
    if not topic and not given:
        return None
    with checked_arguments():
        named = dict(_name_and_topic(text) for text in topic or ())
        return BagOptions(topics=named, **given)


def _name_and_topic(text: str) -> tuple[str, str]:
    name, _, topic = text.partition("=")
    if not name or not topic:
        raise ValueError(f"--topic {text}: expected NAME=/TOPIC, as in lidar=/velodyne_points")
    return name, topic


def matcher_from(
    name: str,
    weights: list[Path] | None,
    *,
    seed: int,
    all_frames: bool = False,
    **options: Any,
) -> Matcher:
    """The matcher of that name, or a table of correspondences.

    Args:
        name: ``structure``, ``cmrnext`` or a file.
        weights: of cmrnext.
        seed: of everything random.
        all_frames: match all frames, as when the user has selected them.
        options: of cmrnext, and the search_deg and search_m of structure; None if not given.
    """
    given = {key: value for key, value in options.items() if value is not None}
    own = {key: given.pop(key) for key in _SEARCH_OPTIONS if key in given}
    if own and name != "structure":
        raise ValueError(f"{_flag(next(iter(own)))} is for --matcher structure only")
    if name == "cmrnext" and weights:
        from calibgraph.matching.cmrnext import CmrNextMatcher

        return CmrNextMatcher(weights, seed=seed, **given)
    if name != "cmrnext":
        _refuse_cmrnext_options(weights, given)
    if name == "structure":
        return _structure_matcher(own, seed=seed, all_frames=all_frames)
    from calibgraph.matching.named import find_matcher

    return find_matcher(name, seed=seed)


def _refuse_cmrnext_options(weights: list[Path] | None, given: dict[str, Any]) -> None:
    for option in (*(["weights"] if weights else []), *given):
        raise ValueError(f"{_flag(option)} is for --matcher cmrnext only")


def _structure_matcher(given: dict[str, Any], *, seed: int, all_frames: bool) -> Matcher:
    from calibgraph.matching.structure import StructureMatcher

    search = {key: _parse_range(key, given[key]) for key in _SEARCH_OPTIONS if key in given}
    if len(search) == len(_SEARCH_OPTIONS) and len({n is None for n in search.values()}) > 1:
        raise ValueError("--search-deg and --search-m: give numbers, or none for no search")
    settings: dict[str, Any] = dict(search)
    if None in search.values():
        settings.update(dict.fromkeys(_SEARCH_OPTIONS))
    if all_frames:
        settings["most_frames"] = None
    return StructureMatcher(seed=seed, **settings)


def _parse_range(name: str, text: str) -> float | None:
    """The number in an option's text, None for ``none``."""
    if text == "none":
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{_flag(name)} {text}: give a number, or none") from None


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def config_from(
    config: Path | None, preset_name: str | None, **given: float | str | None
) -> Config:
    """The settings of a file or of a preset; options that are given replace theirs."""
    from calibgraph.model.config import load_config, preset

    if config is not None and preset_name is not None:
        raise ValueError("--config and --preset exclude each other; put `preset:` into the file")
    if (start := given.get("estimate")) in ("frame", "joint"):  # its former meaning
        raise ValueError(f"--estimate {start}: is of lens and clock; give --start-from {start}")
    settings = (
        load_config(config)
        if config is not None
        else preset("auto" if preset_name is None else preset_name)
    )
    return settings.changed(**{k: v for k, v in given.items() if v is not None})


def terms_from(name: str) -> Terms:
    """The terms of the objective of that name."""
    from calibgraph.model.config import TERMS

    for terms in TERMS:
        if name == terms:
            return terms
    raise ValueError(f"--terms {name!r}: known are {', '.join(TERMS)}")


def require_service() -> None:
    """Check that the server's packages are there."""
    from calibgraph.errors import needs_extra

    with needs_extra("service", "the server needs fastapi, hypercorn and others"):
        import fastapi  # noqa: F401
        import hypercorn  # noqa: F401
        import python_multipart  # noqa: F401
        import sqlalchemy  # noqa: F401
