"""What a process with trackers gets, and how it refuses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Action = Literal["create", "frames", "state", "plot", "remove", "close all"]
ARROW = "application/vnd.apache.arrow.stream"


@dataclass(frozen=True)
class TrackerRequest:
    """A request to a tracker.

    Attributes:
        action: what to do.
        folder: of the tracker.
        body: of the request: the rig, or frames.
        content_type: of frames.
        config: settings, as JSON.
    """

    action: Action
    folder: str
    body: bytes = b""
    content_type: str = ""
    config: str = "{}"


@dataclass(frozen=True)
class Refusal:
    """An answer that refuses.

    Attributes:
        status: of HTTP.
        detail: what is wrong, in one line.
    """

    status: int
    detail: str
