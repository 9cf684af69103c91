"""The outcome of each image, and the matcher's findings from all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.cmrnext.checkpoint import Checkpoint
from calibgraph.matching.cmrnext.flow_matching import MatchingJob
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings


@dataclass(frozen=True, eq=False)
class ImageResult:
    """The outcome of one image.

    Attributes:
        job: with the estimate from which the last network started.
        matches: of the last network.
        T_camera_lidar: (4, 4) estimated from them by PnP; None if that failed.
        failed: whether a network gave no pose, or one beyond its range of training.
        start_dependence: see :mod:`calibgraph.matching.cmrnext.probe`; None if not measured.
        memorization: see the same module; None if not measured.
    """

    job: MatchingJob
    matches: Correspondences
    T_camera_lidar: Array | None
    failed: bool
    start_dependence: float | None = None
    memorization: float | None = None

    def next_job(self) -> MatchingJob:
        """The job of the next network: from the new estimate, unless it failed."""
        if self.failed or self.T_camera_lidar is None:
            return self.job
        return replace(self.job, T_camera_lidar=self.T_camera_lidar)


def without_failed(results: list[ImageResult]) -> list[ImageResult]:
    """The results that did not fail; if all did, all, so that the solve reports the failure."""
    return [result for result in results if not result.failed] or results


def list_failed_frames(results: Mapping[str, Sequence[ImageResult]]) -> dict[str, list[str]]:
    """Names of the failed frames of each camera."""
    return {
        name: [result.job.frame.name for result in each if result.failed]
        for name, each in results.items()
    }


def to_findings(results: Mapping[str, Sequence[ImageResult]], last: Checkpoint) -> MatcherFindings:
    """Failed frames, in the last round the probes, and the shared error of the last network."""
    failed = list_failed_frames(results)
    prior = asdict(error_components().matchers["cmrnext"])
    stated = {key: last.config[key] for key in prior if last.config.get(key) is not None}
    return MatcherFindings(
        failed_share={name: len(failed[name]) / len(each) for name, each in results.items()},
        start_dependence=_medians(results, "start_dependence"),
        memorization=_medians(results, "memorization"),
        **{**prior, **stated},
    )


def _medians(results: Mapping[str, Sequence[ImageResult]], attribute: str) -> dict[str, float]:
    """Median of a probe over the frames of each probed camera; NaN if none could be measured."""
    values = {name: [getattr(result, attribute) for result in each]
              for name, each in results.items()}  # fmt: skip
    probed = {name: [v for v in each if v is not None] for name, each in values.items()}
    return {name: _finite_median(each) for name, each in probed.items() if each}


def _finite_median(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else float("nan")
