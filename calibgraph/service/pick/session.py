"""A session of picking: its pairs with undo and redo, saved after every change."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, write_text
from calibgraph.service.pick.pairs import Pair

SESSION_FILE = "session.json"
SESSION_FORMAT: Literal["calibgraph-pick/1"] = "calibgraph-pick/1"
MAX_UNDO = 100
MAX_PAIRS = 2000  # by hand

Pairs = tuple[Pair, ...]


class Session(BaseModel):
    """The pairs, and what they were before and after.

    Attributes:
        dataset: names of the dataset's frames, by which a session is known to fit it.
        cameras: the rig's.
        revision: counts the changes.
        pairs: in the order in which they were picked.
        past, future: earlier states for undo, and those undone for redo.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["calibgraph-pick/1"] = SESSION_FORMAT
    dataset: tuple[str, ...]
    cameras: tuple[str, ...]
    revision: int = 0
    pairs: Pairs = ()
    past: tuple[Pairs, ...] = ()
    future: tuple[Pairs, ...] = ()

    def with_pairs(self, pairs: Sequence[Pair]) -> Session:
        """The session with other pairs, which undo takes back."""
        past = (*self.past, self.pairs)[-MAX_UNDO:]
        return self._changed(tuple(pairs), past, ())

    def undone(self) -> Session:
        """One change back; the same session if there is none."""
        if not self.past:
            return self
        return self._changed(self.past[-1], self.past[:-1], (self.pairs, *self.future))

    def redone(self) -> Session:
        """One undone change again; the same session if there is none."""
        if not self.future:
            return self
        return self._changed(self.future[0], (*self.past, self.pairs), self.future[1:])

    def _changed(self, pairs: Pairs, past: tuple[Pairs, ...], future: tuple[Pairs, ...]) -> Session:
        return self.model_copy(
            update={
                "revision": self.revision + 1, "pairs": pairs, "past": past, "future": future
            }
        )  # fmt: skip

    def save(self, path: Path) -> None:
        """Write the session atomically."""
        write_text(path, json.dumps(self.model_dump(), separators=(",", ":")) + "\n")


def load_session(path: Path) -> Session:
    """Read a session."""
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is not JSON ({error}); move it away to begin anew") from error
    return checked_model(Session, content, path)


def open_session(path: Path, frames: Sequence[str], cameras: Sequence[str]) -> Session:
    """The session of a file, or a new one.

    Raises:
        FileError: if the file is of another dataset or no session.
    """
    if not path.exists():
        return Session(dataset=tuple(frames), cameras=tuple(cameras))
    session = load_session(path)
    if session.dataset != tuple(frames) or session.cameras != tuple(cameras):
        raise FileError(
            path,
            "is a session of other frames or cameras; give the same --frames, or another --out",
        )
    return session
