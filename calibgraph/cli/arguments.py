"""Option values to library objects: the dataset and the matcher of a command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.cli.terminal import print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.io.bags import BagOptions
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher

_SEARCH_OPTIONS = ("search_deg", "search_m")
_SEARCH_LIMIT_S = 1800.0


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
    weights: list[Path] | None = None,
    *,
    seed: int,
    all_frames: bool = False,
    of_cmrnext: Mapping[str, Any] | None = None,
    **search: str | None,
) -> Matcher:
    """The matcher of that name, or a table of correspondences.

    Args:
        name: ``structure``, ``cmrnext`` or a file.
        weights: of cmrnext.
        seed: of everything random.
        all_frames: match all frames, as when the user has selected them.
        of_cmrnext: its settings.
        search: the search_deg and search_m of structure; None if not given.
    """
    given = {key: value for key, value in search.items() if value is not None}
    if given and name != "structure":
        raise ValueError(f"{_flag(next(iter(given)))} is for --matcher structure only")
    if name == "cmrnext" and weights:
        from calibgraph.matching.cmrnext import CmrNextMatcher

        return CmrNextMatcher(weights, seed=seed, **of_cmrnext or {})
    if name != "cmrnext":
        for what in ("--weights",) if weights else of_cmrnext or ():
            raise ValueError(f"{what} is for --matcher cmrnext only")
    if name == "structure":
        return _structure_matcher(given, seed=seed, all_frames=all_frames)
    from calibgraph.matching.named import find_matcher

    return find_matcher(name, seed=seed)


def time_limit_of(matcher: str, time_limit_s: float | None) -> float | None:
    """The time limit, by default the search's. Networks may need hours on a CPU."""
    default = _SEARCH_LIMIT_S if matcher == "structure" else None
    return default if time_limit_s is None else time_limit_s


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


def parse_names(option: str, texts: list[str] | None) -> dict[str, str]:
    """The pairs of a repeated option A=B."""
    for text in texts or ():
        if "=" not in text:
            raise ValueError(f"{option} {text!r}: give two names with = between them")
    pairs = [text.partition("=") for text in texts or ()]
    for name, count in Counter(name for name, _, _ in pairs).items():
        if count > 1:
            raise ValueError(f"{option} {name}=...: given {count} times; give it once")
    return {name: value for name, _, value in pairs}


def require_service() -> None:
    """Check that the server's packages are there."""
    from calibgraph.errors import needs_extra

    with needs_extra("service", "the server needs fastapi, hypercorn and others"):
        import fastapi  # noqa: F401
        import hypercorn  # noqa: F401
        import python_multipart  # noqa: F401
        import sqlalchemy  # noqa: F401
