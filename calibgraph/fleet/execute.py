"""One job in one process: fetch, calibrate or solve, and return what the rows hold."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.errors import CalibrationError
from calibgraph.fleet.task import CameraResult, Outcome, Task, describe_failure
from calibgraph.fleet.uris import fetch
from calibgraph.model.versions import package_versions

if TYPE_CHECKING:
    from calibgraph.model.calibration import Calibration


def execute(task: Task, folder: Path) -> Outcome:
    """Run a job; what is wrong with its data or its machine is part of the outcome."""
    places = dict[str, str]()
    try:
        cameras = _results(_calibrate(task, _fetcher(task, folder, places)))
        return Outcome(cameras=cameras, versions=versions_text())
    except Exception as error:
        kind, text = describe_failure(error)
    for place, uri in places.items():
        text = text.replace(place, uri)
    return Outcome(error_kind=kind, error=str(CalibrationError(text)), versions=versions_text())


def versions_text() -> str:
    """The versions that results depend on, as JSON."""
    return json.dumps(package_versions())


def version_in(versions: str) -> str:
    """The version of this package in such a text."""
    return str(json.loads(versions).get("calibgraph"))


def _fetcher(task: Task, folder: Path, places: dict[str, str]) -> Callable[[str], Path]:
    """A function from URIs to local paths, which notes in ``places`` what it copied."""

    def local(uri: str) -> Path:
        target = folder / str(len(places))
        target.mkdir()
        try:
            path = fetch(uri, target, task.limits.fetch_bytes)
        except CalibrationError:
            raise
        except Exception as error:  # of any store's client: the next time it may work
            raise OSError(f"{uri}: cannot be fetched ({error})") from error
        places[str(path)] = uri
        return path

    return local


def _calibrate(task: Task, local: Callable[[str], Path]) -> Calibration:
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.structure import StructureMatcher
    from calibgraph.pipeline import calibrate, solve

    job, settings = task.job, task.job.settings
    rig = load_rig(local(job.rig)) if job.rig else None
    paths = [local(uri) for uri in job.recordings]
    if job.is_table and rig is not None:
        return solve(rig, paths[0], settings.config, settings.terms)
    given = {"search_deg": settings.search_deg, "search_m": settings.search_m}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if settings.frames is not None:
        options["most_frames"] = None
    return calibrate(
        load_dataset(paths, rig, frames=settings.frames),
        matcher=StructureMatcher(seed=settings.config.seed, **options),
        config=settings.config,
        terms=settings.terms,
        time_limit_s=task.limits.timeout_s / 2,  # the rest is for the checks
        progress=_print_stages(),
    )


def _print_stages() -> Callable[[str, int, int], None]:
    """A progress callback that prints each stage once, for the vehicle's log."""
    start, last = time.perf_counter(), [""]

    def progress(stage: str, done: int, total: int) -> None:
        if stage != last[0]:
            print(f"{time.perf_counter() - start:8.1f} s  {stage}", flush=True)
            last[0] = stage

    return progress


def _results(result: Calibration) -> tuple[CameraResult, ...]:
    covariance = result.covariance
    return tuple(
        CameraResult(
            camera=name,
            verdict=verdict.status,
            cannot_tell=verdict.cannot_tell,
            probability_off=None
            if verdict.error_probability is None
            else verdict.error_probability.probability,
            reasons=tuple(reason.text for reason in result.summary_of(name).reasons),
            actions=result.summary_of(name).actions,
            of=result.config.of,
            T_camera_lidar=tuple(result.T_camera_lidar[name].ravel().tolist()),
            covariance=None if (c := covariance[name]) is None else tuple(c.ravel().tolist()),
        )
        for name, verdict in result.camera_verdicts.items()
    )
