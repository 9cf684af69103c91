"""A manifest from its rows to the rows of its results: ``run_fleet``, all of them or a shard."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field

from calibgraph.errors import CalibrationError, FileError
from calibgraph.fleet.driver import Driver, Publisher, Try
from calibgraph.fleet.engines import Engine, open_engine
from calibgraph.fleet.execute import version_in
from calibgraph.fleet.manifest import Job, Manifest, load_manifest
from calibgraph.fleet.rows import BUCKETS, RowStore
from calibgraph.fleet.task import Limits, Outcome, release
from calibgraph.progress import Progress, no_progress

_READERS = 16  # threads that look at inputs: a listing of an object store takes 50 ms
_ARRAYS = "JOB_COMPLETION_INDEX", "AWS_BATCH_JOB_ARRAY_INDEX", "SLURM_ARRAY_TASK_ID"
_STATE = ("vehicle", "recording", "status", "verdict", "error_kind", "input_hash", "versions")


@dataclass(frozen=True)
class Shard:
    """The buckets ``b`` with ``b % count == index``: no two shards write one file.

    Raises:
        CalibrationError: if the index is not below the count, or there are more than 256.
    """

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count <= BUCKETS:
            raise CalibrationError(
                f"shard {self.index}/{self.count}: expected i/n with 0 <= i < n <= {BUCKETS}"
            )

    def has(self, bucket: int) -> bool:
        """Whether a bucket is in this shard."""
        return bucket % self.count == self.index


def shard_from(text: str | None, environment: Mapping[str, str]) -> Shard:
    """The shard of a text ``i/n``; all without one.

    Raises:
        CalibrationError: if it is none, or is not given in an array of jobs of a scheduler: each
            process of it would do all.
    """
    if text is None:
        if found := [name for name in _ARRAYS if environment.get(name)]:
            raise CalibrationError(
                f"{found[0]} is set: state the part of this process of the array, "
                f"--shard ${found[0]}/N, or --shard 0/1 for all"
            )
        return Shard()
    index, _, count = text.partition("/")
    try:
        return Shard(int(index), int(count))
    except ValueError:
        raise CalibrationError(f"--shard {text}: expected i/n, as 0/8") from None


@dataclass(frozen=True)
class Summary:
    """What is known of a manifest's jobs after a run.

    Attributes:
        jobs: of the manifest, in the shard.
        skipped: of them those that were finished before.
        retries: tries beyond the first of a job.
        verdicts: per verdict, the cameras, those of skipped jobs too.
        failures: per kind of failure, the jobs.
    """

    jobs: int
    skipped: int
    retries: int
    verdicts: dict[str, int] = field(default_factory=dict)
    failures: dict[str, int] = field(default_factory=dict)


def run_fleet(
    manifest: str,
    out: str,
    *,
    engine: Engine | str = "processes",
    slots: int | None = None,
    shard: Shard | None = None,
    limits: Limits | None = None,
    allow_missing: bool = False,
    logs: bool = True,
    progress: Progress | None = None,
) -> Summary:
    """Calibrate the vehicles of a manifest, each alone, and publish a row per camera.

    What an earlier run finished with the same inputs is not done again. A failed job is a row.

    Args:
        manifest: path or URI of a table, see ``fleet.manifest.load_manifest``.
        out: folder or URI of the rows.
        engine: where jobs run, see :func:`calibgraph.fleet.engines.open_engine`.
        slots: jobs at once, of an engine by name; one per core if None.
        shard: the part of the manifest that is done; all if None.
        limits: of each job.
        allow_missing: whether missing recordings become failed rows.
        logs: whether what a job printed is kept, below ``_logs``.
        progress: called as the work goes on.

    Raises:
        CalibrationError: before anything is done, if the manifest is wrong, inputs are missing, or
            rows or workers are of another version; in the end, if another run has replaced rows.
    """
    report, shard, limits = progress or no_progress, shard or Shard(), limits or Limits()
    found, store = load_manifest(manifest), RowStore(out)
    jobs = [job for job in found.jobs if shard.has(job.bucket)]
    finished = _finished(store, jobs)
    tries = _first_tries(found, jobs, report, allow_missing=allow_missing)
    todo = [each for each in tries if (each.job.key, each.input_hash) not in finished]
    publisher = Publisher(store, found.others, logs=logs)
    with _opened(engine, slots, limits) as runs_here:
        retries = Driver(runs_here, publisher, limits).run(todo, report)
    return _summary(store, jobs, len(jobs) - len(todo), retries)


def _opened(
    engine: Engine | str, slots: int | None, limits: Limits
) -> AbstractContextManager[Engine]:
    """An engine by name, closed afterwards; or one that its owner closes."""
    if isinstance(engine, str):
        return closing(open_engine(engine, slots, limits.memory_bytes))
    return nullcontext(engine)


def _finished(store: RowStore, jobs: Sequence[Job]) -> set[tuple[tuple[str, str], str]]:
    """The keys and input hashes of what need not be done again."""
    found, own = set(), {job.key for job in jobs}
    for row in _states(store, jobs):
        if (row["vehicle"], row["recording"]) not in own:
            continue
        if version_in(row["versions"]) != release():
            raise FileError(
                store.uri, f"holds rows of calibgraph {version_in(row['versions'])}, this is "
                f"{release()}; choose another --out"
            )  # fmt: skip
        if row["status"] == "done" or row["error_kind"] == "bad input":
            found.add(((row["vehicle"], row["recording"]), row["input_hash"]))
    return {each for each in found if each[1]}


def _states(store: RowStore, jobs: Sequence[Job]) -> Iterator[dict[str, str]]:
    """The rows in the buckets of these jobs, without their numbers."""
    for bucket in sorted({job.bucket for job in jobs}):
        rows = store.read(bucket, _STATE)
        if rows is not None:
            yield from rows.to_pylist()


def _first_tries(
    manifest: Manifest, jobs: Sequence[Job], report: Progress, *, allow_missing: bool
) -> list[Try]:
    """The jobs by bucket, with the hashes of their inputs."""
    ordered = sorted(jobs, key=lambda job: (job.bucket, job.row))
    tries = []
    with ThreadPoolExecutor(_READERS) as pool:
        for number, each in enumerate(pool.map(_first_try, ordered)):
            report("reading inputs", number, len(ordered))
            tries.append(each)
    missing = sorted((each for each in tries if each.known), key=lambda each: each.job.row)
    if missing and not allow_missing:
        first, others = missing[0], len(missing) - 1
        raise FileError(
            manifest.uri, f"row {first.job.row}: {first.known.error if first.known else ''}"
            + (f" (and {others} more)" if others else "")
            + "; correct it, or make failed rows of them by --allow-missing"
        )  # fmt: skip
    return tries


def _first_try(job: Job) -> Try:
    try:
        return Try(job, job.input_hash())
    except FileNotFoundError as error:
        text = f"{error.args[0]}: nothing is there"
        return Try(job, "", known=Outcome(error_kind="bad input", error=text))
    except FileError as error:  # no such kind of URI
        return Try(job, "", known=Outcome(error_kind="bad input", error=str(error)))
    except Exception:  # of any store's client: the job will fail by it, or not
        return Try(job, "")


def _summary(store: RowStore, jobs: Sequence[Job], skipped: int, retries: int) -> Summary:
    verdicts, failures, own = Counter[str](), Counter[str](), {job.key for job in jobs}
    found = set()
    for row in _states(store, jobs):
        key = row["vehicle"], row["recording"]
        if key not in own:
            continue
        found.add(key)
        if row["status"] == "done":
            verdicts[row["verdict"]] += 1
        else:
            failures[row["error_kind"]] += 1
    if len(found) < len(own):
        raise FileError(
            store.uri, f"the rows of {len(own) - len(found)} jobs were replaced by another command "
            "that wrote here at the same time; give the same command again"
        )  # fmt: skip
    return Summary(len(jobs), skipped, retries, dict(verdicts), dict(failures))
