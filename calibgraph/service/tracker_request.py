"""What a process with trackers gets, and how it refuses."""

from dataclasses import dataclass
from typing import Literal

Action = Literal["create", "frames", "state", "plot", "remove", "close all"]


@dataclass(frozen=True)
class TrackerRequest:
    """A request to a tracker: its body is a rig or frames, its config JSON."""

    action: Action
    folder: str
    body: bytes = b""
    config: str = "{}"


@dataclass(frozen=True)
class Refusal:
    """An answer that refuses, with the status of HTTP."""

    status: int
    detail: str


@dataclass(frozen=True)
class FramesTaken:
    """The answer to frames: how many were taken in, and the JSON of the updates, which is sent."""

    count: int
    body: str
