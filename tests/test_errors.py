"""Messages of errors."""

from __future__ import annotations

from calibgraph import (
    CalibrationError,
)


def test_errors_are_one_line() -> None:
    assert str(CalibrationError("a\n  b")) == "a b"
