"""Option values to library objects: the dataset and the matcher of a command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.cli.terminal import print_line, progress_bar

if TYPE_CHECKING:
    from calibgraph.io.bags import BagOptions
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher

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
        print_line(note)
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
        topics = parse_names("--topic", topic, "NAME=/TOPIC, as lidar=/velodyne_points")
        return BagOptions(topics=topics, **given)


def bag_settings(config: Path | None, topic: list[str] | None, **options: Any) -> BagOptions | None:
    """See :func:`bag_options_from`; a file of settings has some of them."""
    from calibgraph.cli.settings import read_settings

    with checked_arguments():
        _, rare = read_settings(config)
    return bag_options_from(topic, **options, **rare.of_bags)


def matcher_from(
    name: str,
    weights: list[Path] | None = None,
    *,
    seed: int,
    all_frames: bool = False,
    of_cmrnext: Mapping[str, Any] | None = None,
    **search: float | None,
) -> Matcher:
    """The matcher of that name, or a table of correspondences.

    Args:
        name: ``structure``, ``cmrnext`` or a file.
        weights: of cmrnext.
        seed: of everything random.
        all_frames: match all frames, as when the user has selected them.
        of_cmrnext: its settings.
        search: the search_deg and search_m of structure; None if not given, 0 for no search.
    """
    for option in search if name != "structure" else ():
        if search[option] is not None:
            raise ValueError(f"--{option.replace('_', '-')} is for --matcher structure only")
    for option in [*(["--weights"] if weights else []), *(of_cmrnext or {})]:
        if name != "cmrnext":
            raise ValueError(f"{option} is for --matcher cmrnext only")
    from calibgraph.matching.named import find_matcher, structure_matcher

    if name == "structure":
        return structure_matcher(seed=seed, all_frames=all_frames, **search)
    if name == "cmrnext" and weights:
        from calibgraph.matching.cmrnext import CmrNextMatcher

        return CmrNextMatcher(weights, seed=seed, **of_cmrnext or {})
    return find_matcher(name, seed=seed)


def time_limit_of(matcher: str, time_limit_s: float | None) -> float | None:
    """The time limit, by default the search's. Networks may need hours on a CPU."""
    default = _SEARCH_LIMIT_S if matcher == "structure" else None
    return default if time_limit_s is None else time_limit_s


def parse_names(
    option: str, texts: list[str] | None, form: str = "two names with = between them"
) -> dict[str, str]:
    """The pairs of a repeated option A=B."""
    for text in texts or ():
        if not all(text.partition("=")):
            raise ValueError(f"{option} {text!r}: give {form}")
    pairs = [text.partition("=") for text in texts or ()]
    for name, count in Counter(name for name, _, _ in pairs).items():
        if count > 1:
            raise ValueError(f"{option} {name}=...: given {count} times; give it once")
    return {name: value for name, _, value in pairs}
