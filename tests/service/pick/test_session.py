from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph.errors import FileError
from calibgraph.service.pick.session import MAX_UNDO, Session, load_session, open_session
from calibgraph.simulation.rigs import rig_of
from tests.service.pick.builders import draw_pairs


@pytest.fixture
def session() -> Session:
    return Session(dataset=("000000", "000001"), cameras=("image_2", "image_3"))


PAIRS = draw_pairs(rig_of("kitti"), "image_2", 3, np.random.default_rng(0))


def test_undo_and_redo_go_through_all_states(session: Session) -> None:
    for count in (1, 2, 3):
        session = session.with_pairs(PAIRS[:count])
    assert len(session.undone().undone().pairs) == 1
    assert session.undone().undone().redone().redone().pairs == session.pairs
    assert session.undone().with_pairs(PAIRS[:1]).future == ()


def test_undo_and_redo_without_a_change_keep_the_session(session: Session) -> None:
    assert session.undone() is session
    assert session.redone() is session


def test_the_history_is_bounded(session: Session) -> None:
    for _ in range(MAX_UNDO + 5):
        session = session.with_pairs(PAIRS)
    assert len(session.past) == MAX_UNDO


def test_a_saved_session_is_the_same_with_its_history(session: Session, tmp_path: Path) -> None:
    session = session.with_pairs(PAIRS).with_pairs(PAIRS[:1]).undone()
    session.save(tmp_path / "session.json")
    assert load_session(tmp_path / "session.json") == session


def test_a_session_of_other_frames_is_refused(session: Session, tmp_path: Path) -> None:
    session.save(tmp_path / "session.json")
    with pytest.raises(FileError, match="session of other frames or cameras"):
        open_session(tmp_path / "session.json", ["000007"], ["image_2", "image_3"])


@pytest.mark.parametrize("text", ["", "[]", "{", "{}", "[" * 100_000])
def test_a_broken_session_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text(text)
    with pytest.raises(FileError):
        load_session(tmp_path / "session.json")
