"""The outcome of each image, and the matcher's findings from all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

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
    """

    job: MatchingJob
    matches: Correspondences
    T_camera_lidar: Array | None
    failed: bool

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
    """Failed frames, and the shared error of the last network."""
    failed = list_failed_frames(results)
    prior = asdict(error_components().matchers["cmrnext"])
    stated = {key: last.config[key] for key in prior if last.config.get(key) is not None}
    return MatcherFindings(
        failed_share={name: len(failed[name]) / len(each) for name, each in results.items()},
        **{**prior, **stated},
    )
