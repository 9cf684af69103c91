"""From images and clouds to a calibration: match, solve, and match again from the estimate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Calibration
from calibgraph.config import Config, Terms
from calibgraph.correspondence_file import load_correspondences
from calibgraph.correspondences import Correspondences
from calibgraph.dataset import Dataset, load_dataset
from calibgraph.files import sha256
from calibgraph.rig import Rig, angle_deg
from calibgraph.two_pass import Clock, solve
from calibgraph.verdict import Matching, rig_verdict, with_matching

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
"""Told of progress: what is being done, how much of it is done, out of how much."""


class Matcher(Protocol):
    """What finds correspondences. It may want several rounds, each from a better estimate.

    The verdict heeds what the metadata of its tables says, each a mapping of camera names:
    ``contrast``: by how many chance spreads the matches' agreement stands out;
    ``start_dependence``: which share of a displaced start remains in the matches (0 to 1);
    ``recall``: which share of the way back it finds without the image (0 to 1);
    ``failed_share``: which share of the frames it left out (0 to 1).

    For single frames of a drive, near a good estimate, it may have an attribute
    ``tracking_rounds``: which of its rounds to go through then; otherwise it is all of them.

    Attributes:
        rounds: how many rounds it wants.
        stage1: where the pairwise estimates come from, see ``Config.stage1``.
    """

    rounds: int
    stage1: Literal["pnp", "rig"]

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Find the correspondences of all cameras and frames.

        Args:
            dataset: images and clouds.
            rig: lenses, and the present estimate of the poses.
            round_index: 0 .. rounds - 1.
            progress: to be told how far it is.
        """
        ...


class Precomputed:
    """A matcher that has done its work already: a table, from a file or in memory."""

    rounds = 1
    stage1: Literal["pnp", "rig"] = "pnp"

    def __init__(self, table: Correspondences) -> None:
        self.table = table

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Return the rows of the table that belong to the dataset's frames."""
        frames = np.array([frame.index for frame in dataset.frames])
        return self.table.select(np.isin(self.table.frame, frames))


def calibrate(
    dataset: Dataset | Path | str | Sequence[Path | str],
    rig: Rig | None = None,
    matcher: Matcher | Correspondences | Path | str = "structure",
    config: Config | None = None,
    *,
    terms: Terms = "full",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate all cameras of a rig jointly from images and clouds.

    Args:
        dataset: a dataset, its folder, a KITTI odometry sequence, or several folders of one rig.
        rig: the initial guess; the rig that lies with the data if None.
        matcher: ``structure``; a matcher of your own; or correspondences, from a file or in memory.
        config: settings of the solve; the preset ``auto`` if None.
        terms: of the objective, see :func:`calibgraph.solve`.
        progress: called as the work goes on.

    Returns:
        The calibration, with the correspondences of its last round.

    Raises:
        FileError, DatasetError: if the data cannot be read or do not fit together.
        CorrespondenceError: if a camera gets too few correspondences.
        ValueError: if the matcher is unknown.
    """
    config = config or Config()
    chosen = matcher_named(matcher, seed=config.seed)
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, rig)
    initial = rig if rig is not None else data.rig
    if chosen.stage1 == "rig":
        config = config.changed(stage1="rig")
    if chosen.rounds < 1:
        raise ValueError(f"the matcher wants {chosen.rounds} rounds, expected at least 1")
    report = progress or (lambda what, done, total: None)
    clock, rounds, estimate = Clock(), list[dict[str, Any]](), initial
    for index in range(chosen.rounds):
        with clock("match"):
            table = chosen.match(data, estimate, round_index=index, progress=report)
        with clock("solve"):
            result = solve(estimate, table, config, terms)
        rounds.append(_round(table, estimate, result.rig))
        estimate = result.rig
    report("done", chosen.rounds, chosen.rounds)
    with clock("hash_inputs"):
        inputs = _input_hashes(data)
    return replace(
        _judged_by_rounds(result, rounds, repeated=_repeated_frame(data, inputs)),
        initial_rig=initial,
        correspondences=table,
        rounds=tuple(rounds),
        inputs=inputs,
        timings_s=clock.seconds,
    )


def matcher_named(matcher: Matcher | Correspondences | Path | str, *, seed: int = 0) -> Matcher:
    """A matcher by its name, by the file of its correspondences, or as it is.

    Args:
        matcher: what the user said.
        seed: for a matcher by name that draws random numbers.

    Raises:
        ValueError: if it is a name, but not of a matcher.
        FileError, CorrespondenceError: if it is a file, but not a table.
    """
    if isinstance(matcher, Correspondences):
        return Precomputed(matcher)
    if not isinstance(matcher, (str, Path)):
        return matcher
    if str(matcher) == "structure":
        from calibgraph.structure import StructureMatcher

        return StructureMatcher(seed=seed)
    if Path(matcher).suffix in (".parquet", ".csv"):
        return Precomputed(load_correspondences(matcher))
    if str(matcher) == "cmrnext":
        raise ValueError(
            "the matcher 'cmrnext' needs weights: --weights iter1.tar iter5.tar iter6.tar, or "
            "calibgraph.cmrnext.CmrNextMatcher([...])"
        )
    raise ValueError(
        f"unknown matcher {str(matcher)!r}; known are 'structure', 'cmrnext' and a table of "
        "correspondences (.parquet or .csv)"
    )


def _round(table: Correspondences, before: Rig, after: Rig) -> dict[str, Any]:
    """What one round found, and how far it moved each camera."""
    counts = table.counts()
    cameras = {}
    for name, old in before.T_camera_lidar.items():
        delta = after.T_camera_lidar[name] @ np.linalg.inv(old)
        cameras[name] = {
            "matches": counts.get(name, 0),
            "moved_deg": angle_deg(delta[:3, :3]),
            "moved_cm": 100.0 * float(np.linalg.norm(delta[:3, 3])),
        }
    return cameras


def _judged_by_rounds(
    result: Calibration, rounds: Sequence[dict[str, Any]], *, repeated: str | None
) -> Calibration:
    """The result with a verdict that knows of all rounds, not only of the last solve."""
    verdicts = {
        name: with_matching(
            verdict,
            Matching(
                moved_deg=rounds[-1][name]["moved_deg"] if len(rounds) > 1 else 0.0,
                moved_cm=rounds[-1][name]["moved_cm"] if len(rounds) > 1 else 0.0,
                repeated=repeated,
            ),
        )
        for name, verdict in result.camera_verdicts.items()
    }
    return replace(result, camera_verdicts=verdicts, verdict=rig_verdict(verdicts))


def _input_hashes(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of every cloud and image, by path."""
    files = [
        path for frame in dataset.frames for path in (frame.cloud_path, *frame.image_paths.values())
    ]
    return {str(path): sha256(path) for path in files}


def _repeated_frame(dataset: Dataset, hashes: dict[str, str]) -> str | None:
    """Two frames with the very same cloud, if there are any: they are no independent evidence."""
    seen: dict[str, str] = {}
    for frame in dataset.frames:
        digest = hashes[str(frame.cloud_path)]
        if digest in seen:
            return f"frames {seen[digest]} and {frame.name} have the same cloud"
        seen[digest] = frame.name
    return None
