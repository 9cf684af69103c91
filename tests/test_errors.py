"""Messages of errors."""

from __future__ import annotations

import tokenize
import zipfile

import pytest

from calibgraph.errors import in_words, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2J", "\\x1b[2J"),
        ("a\x7fb\x9b2J", "a\\x7fb\\x9b2J"),
        ("rig\u202elmay.gir", "rig\\u202elmay.gir"),
        ("a\rb\u2028c\ud800", "a\\rb\\u2028c\\ud800"),
        ("Kamera größer\n\tü 前 שלום", "Kamera größer\n\tü 前 שלום"),
    ],
)
def test_characters_that_are_not_seen_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


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
