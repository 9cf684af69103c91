"""Which part of a manifest a process does, where processes are started side by side."""

from collections.abc import Mapping
from dataclasses import dataclass

from calibgraph.errors import CalibrationError
from calibgraph.fleet.rows import BUCKETS

_ARRAYS = (
    ("JOB_COMPLETION_INDEX", "JOB_COMPLETIONS", ""),  # Kubernetes sets no count
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE", ""),
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"),
)
"""Per scheduler, the variables of the index, the number of processes, and the first index."""


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
    """The shard of a text ``i/n`` or ``auto/n``, else the scheduler's array's, else all.

    Raises:
        CalibrationError: if it is neither, or the scheduler gave an index without a count.
    """
    index, slash, count = (text or "auto/").partition("/")
    if not slash:
        raise CalibrationError(f"--shard {text}: expected i/n, as 0/8, or auto/8")
    if index == "auto":
        found = _of_array(environment)
        if found is None:
            if text is None:
                return Shard()
            names = ", ".join(name for name, _, _ in _ARRAYS)
            raise CalibrationError(f"--shard {text}: none of {names} is set; give i/n")
        name, index, given = found
        count = count or given
        if not count:
            raise CalibrationError(
                f"{name} is {index}, but the number of shards is not known; give --shard auto/n"
            )
    try:
        return Shard(int(index), int(count))
    except ValueError:
        raise CalibrationError(f"--shard {index}/{count}: expected two whole numbers") from None


def _of_array(environment: Mapping[str, str]) -> tuple[str, str, str] | None:
    """The variable of the index, the index from 0, and the count or an empty text."""
    for name, size, first in _ARRAYS:
        index = environment.get(name, "")
        if index.isdecimal():
            start = environment.get(first, "0")
            return name, str(int(index) - int(start)), environment.get(size, "")
    return None
