from __future__ import annotations

import pytest

from calibgraph import CalibrationError
from calibgraph.fleet.run import Shard, shard_from


def test_every_bucket_is_in_one_shard() -> None:
    for count in (1, 3, 7, 256):
        owners = [sum(Shard(i, count).has(b) for i in range(count)) for b in range(256)]
        assert owners == [1] * 256


@pytest.mark.parametrize(
    ("text", "environment", "expected"),
    [
        (None, {}, Shard(0, 1)),
        ("2/8", {"JOB_COMPLETION_INDEX": "5"}, Shard(2, 8)),
        ("auto/8", {"JOB_COMPLETION_INDEX": "5"}, Shard(5, 8)),
        (None, {"JOB_COMPLETION_INDEX": "5", "JOB_COMPLETIONS": "6"}, Shard(5, 6)),
        (
            None,
            {"AWS_BATCH_JOB_ARRAY_INDEX": "1", "AWS_BATCH_JOB_ARRAY_SIZE": "4"},
            Shard(1, 4),
        ),
        (
            None,
            {
                "SLURM_ARRAY_TASK_ID": "3",
                "SLURM_ARRAY_TASK_MIN": "1",
                "SLURM_ARRAY_TASK_COUNT": "3",
            },
            Shard(2, 3),
        ),
    ],
)
def test_the_shard_is_that_of_the_option_or_of_the_array(
    text: str | None, environment: dict[str, str], expected: Shard
) -> None:
    assert shard_from(text, environment) == expected


@pytest.mark.parametrize(
    ("text", "environment", "message"),
    [
        ("8/8", {}, "expected i/n with 0 <= i < n <= 256"),
        ("0/257", {}, "expected i/n with 0 <= i < n <= 256"),
        ("3", {}, "expected i/n, as 0/8, or auto/8"),
        ("a/b", {}, "expected two whole numbers"),
        ("auto/8", {}, "none of JOB_COMPLETION_INDEX"),
        (None, {"JOB_COMPLETION_INDEX": "5"}, "give --shard auto/n"),
    ],
)
def test_a_wrong_shard_is_one_line(
    text: str | None, environment: dict[str, str], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        shard_from(text, environment)
