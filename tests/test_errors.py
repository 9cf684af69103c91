"""Messages of errors."""

from __future__ import annotations

import tokenize
import zipfile

import pytest

from calibgraph.errors import CalibrationError, in_words


def test_errors_are_one_line() -> None:
    assert str(CalibrationError("a\n  b")) == "a b"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(), MemoryError((2, 3)), tokenize.TokenError("EOF in multi-line", (1, 0)),
        SyntaxError("x", ("<unknown>", 1, 1, "", 1, 1)), KeyError("descr"), RecursionError(),
        AttributeError("'NoneType' object has no attribute 'x'"), AssertionError(), EOFError(),
        ValueError(), ValueError("no header"), OSError(5, "Input/output error"),
        zipfile.BadZipFile("no zip"),
    ],
)  # fmt: skip
def test_errors_of_libraries_are_put_in_words(error: Exception) -> None:
    words = in_words(error)
    assert words
    assert type(error).__name__ not in words
    assert not set("()'<>") & set(words)
