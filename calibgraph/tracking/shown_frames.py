"""Which live frames show which cameras, for the comparison of their images with the clouds."""

from __future__ import annotations

from collections.abc import Sequence

from calibgraph.tracking.state import State
from calibgraph.trust.pose_posterior import MAX_FRAMES


def groups_by_frames(
    state: State, groups: Sequence[tuple[str, ...]]
) -> dict[tuple[int, ...], list[tuple[str, ...]]]:
    """Groups of cameras by the numbers of the live frames that show all of a group.

    If these are less than half of a camera's own, or of those that are scored, each camera of the
    group is alone, with its own frames. Those that no frame shows are left out.
    """
    found: dict[tuple[int, ...], list[tuple[str, ...]]] = {}
    for group in groups:
        own = [_frames_of(state, name) for name in group]
        common = tuple(number for number in own[0] if all(number in each for each in own))
        parts = [(common, group)]
        if any(2 * len(common) < min(len(each), MAX_FRAMES) for each in own):
            parts = [(each, (name,)) for each, name in zip(own, group, strict=True)]
        for frames, part in parts:
            if frames:
                found.setdefault(frames, []).append(part)
    return found


def _frames_of(state: State, name: str) -> tuple[int, ...]:
    """Numbers of the frames that show a camera at its present pose, as of a drift the last."""
    camera = state.names.index(name)
    frames = tuple(frame.number for frame in state.live_frames if camera in frame.raw)
    return frames[-MAX_FRAMES:] if camera in state.drifting else frames
