from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibgraph import Event, Update
from calibgraph.errors import FileError
from calibgraph.tracking.history import History

Array = NDArray[np.float64]

SIGMA = np.array([1e-4, 2e-4, 3e-4, 1e-3, 2e-3, 3e-3])
START = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -1.2, 0.5), np.array([0.3, -0.2, 0.1]))


def update(
    frame: int,
    xis: Mapping[str, Array] | None = None,
    *,
    unsure: Sequence[str] = (),
    sigma: Array = SIGMA,
    events: Sequence[Event] = (),
) -> Update:
    """An update with cameras at T_camera_lidar = exp(xi) START."""
    xis = {"left": np.zeros(6)} if xis is None else xis
    return Update(
        frame=frame,
        stamp_ns=None,
        T_camera_lidar={
            name: (gtsam.Pose3.Expmap(xi) * START).matrix() for name, xi in xis.items()
        },
        covariance={name: None if name in unsure else np.diag(sigma**2) for name in xis},
        verdicts={},
        events=tuple(events),
        used={},
        left_out=(),
    )


def drive(history: History, frames: int, first: int = 0) -> History:
    """Frames in each of which the camera has turned about x by its number."""
    for frame in range(first, first + frames):
        history.add(update(frame, {"left": 1e-5 * (frame - first) * np.eye(6)[0]}))
    return history


def kept_frames(history: History) -> list[int]:
    curve = history.curves()["left"]
    assert curve is not None
    return [int(frame) for frame in curve.frames]


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def read(path: Path) -> Array:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, dtype=np.float64)


@pytest.mark.parametrize("most", [2, 3, 10, 11])
def test_after_every_update_the_entries_are_evenly_spaced_and_end_with_the_newest(most: int):
    history = History(most)
    for frame in range(200):
        drive(history, 1, first=frame)
        frames = kept_frames(history)
        assert len(frames) == len(history) <= most
        assert frames[0] == 0
        assert frames[-1] == frame
        steps = np.diff(frames)
        assert len(set(steps[:-1])) <= 1
        if len(steps) > 1:
            assert steps[-1] <= steps[0]
            assert np.log2(steps[0]) % 1 == 0


@pytest.mark.parametrize("most", [10, 11])
def test_thinning_keeps_at_least_half_of_what_may_be_held(most: int):
    history = drive(History(most), most)
    for frame in range(most, 500):
        drive(history, 1, first=frame)
        assert len(history) >= most // 2


def test_nothing_is_dropped_before_the_history_is_full():
    assert kept_frames(drive(History(50), 50)) == [*range(50)]


def test_kept_entries_are_those_of_their_frames():
    curve = drive(History(16), 100).curves()["left"]
    assert curve is not None
    # The camera turned by 1e-5 per frame about one axis, so logarithms are exact but for rounding.
    np.testing.assert_allclose(curve.xi[:, 0], 1e-5 * (curve.frames - 99), atol=1e-12)
    np.testing.assert_allclose(curve.xi[:, 1:], 0, atol=1e-12)
    np.testing.assert_allclose(curve.sigma, np.tile(SIGMA, (len(curve.frames), 1)))


def test_curves_end_at_zero_and_bring_the_newest_estimate_to_the_older_ones():
    rng = np.random.default_rng(0)
    xis = 0.1 * rng.standard_normal((5, 6))
    history = History()
    for frame, xi in enumerate(xis):
        history.add(update(frame, {"left": xi}))
    curve = history.curves()["left"]
    assert curve is not None
    np.testing.assert_array_equal(curve.xi[-1], 0)
    for xi, difference in zip(xis, curve.xi, strict=True):
        np.testing.assert_allclose(
            (gtsam.Pose3.Expmap(difference) * gtsam.Pose3.Expmap(xis[-1])).matrix(),
            gtsam.Pose3.Expmap(xi).matrix(),
            atol=1e-12,
        )


def test_memory_does_not_grow_with_the_drive():
    history = drive(History(20), 21)
    arrays = [value for value in vars(history).values() if isinstance(value, np.ndarray)]
    before = [array.nbytes for array in arrays]
    for frame in range(21, 3000):
        found = Event("moved", "left", frame, frame)
        history.add(update(frame, events=[found]))
    after = [value for value in vars(history).values() if isinstance(value, np.ndarray)]
    assert [array.nbytes for array in after] == before
    assert all(new is old for new, old in zip(after, arrays, strict=True))
    assert len(history.events) == 1000


def test_events_outlive_the_entries_of_their_frames():
    history = History(4)
    expected = [Event("moved", "left", 31, 33), Event("blind", "left", 41, 60)]
    for frame in range(1000):
        history.add(update(frame, events=[e for e in expected if e.detected_frame == frame]))
    assert history.events == tuple(expected)
    assert 33 not in kept_frames(history)


def test_of_too_many_events_the_last_thousand_are_kept():
    history = History(4)
    for frame in range(1500):
        history.add(update(frame, events=[Event("moved", "left", frame, frame)]))
    assert [event.frame for event in history.events] == [*range(500, 1500)]


def test_a_camera_begins_with_its_event():
    history = History()
    for frame in range(10):
        began = [Event("started", "left", 4, 4)] if frame == 4 else []
        history.add(update(frame, unsure=["left"], events=began))
    assert kept_frames(history) == [*range(4, 10)]


def test_a_camera_that_had_started_in_an_earlier_run_begins_with_its_covariance():
    history = History()
    for frame in range(10):
        history.add(update(frame, unsure=["left"] if frame < 3 else []))
    assert kept_frames(history) == [*range(3, 10)]


def test_one_camera_s_start_does_not_begin_another():
    xis = {"left": np.zeros(6), "right": np.zeros(6)}
    history = History()
    for frame in range(3):
        began = [Event("started", "left", frame, frame)] if frame == 0 else []
        history.add(update(frame, xis, unsure=["right", "left"], events=began))
    curves = history.curves()
    assert curves["left"] is not None
    assert curves["right"] is None
    rows = np.reshape(history.figure().axes, (2, 2))
    assert texts(rows[0, 0]) == []
    assert texts(rows[1, 0]) == texts(rows[1, 1]) == ["no estimate yet"]
    assert not rows[1, 0].lines


def test_lines_are_in_degrees_and_centimetres_and_bands_are_three_sigma():
    xi = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    history = History()
    # Translation alone or rotation alone: their logarithms are the arguments.
    rotation, translation = xi * [1, 1, 1, 0, 0, 0], xi * [0, 0, 0, 1, 1, 1]
    for frame, given in enumerate([rotation, translation, np.zeros(6)]):
        history.add(update(frame, {"left": given}))
    axes = history.figure().axes
    for panel, unit, rows, frame in (
        (axes[0], 180 / np.pi, slice(0, 3), 0),
        (axes[1], 100.0, slice(3, 6), 1),
    ):
        drawn = np.array([np.asarray(line.get_ydata()) for line in panel.lines])[:, frame]
        low_and_high = unit * (xi[rows, None] + SIGMA[rows, None] * [-3.0, 3.0])
        np.testing.assert_allclose(drawn[:6].reshape(3, 2), low_and_high, atol=1e-9)
        np.testing.assert_allclose(drawn[6:], unit * xi[rows], atol=1e-9)


def test_no_band_is_drawn_without_a_covariance():
    history = History()
    for frame in range(6):
        began = [Event("started", "left", 0, 0)] if frame == 0 else []
        history.add(update(frame, unsure=["left"] if frame < 3 else [], events=began))
    edge = np.asarray(history.figure().axes[0].lines[0].get_ydata())
    np.testing.assert_array_equal(np.isnan(edge), [True, True, True, False, False, False])


def test_a_bad_start_with_a_huge_sigma_does_not_squash_the_rest():
    history = History()
    for frame in range(300):
        bad = frame < 30
        history.add(
            update(frame, {"left": np.full(6, 0.2 * bad)}, sigma=SIGMA * (1000 if bad else 1))
        )
    low, high = history.figure().axes[0].get_ylim()
    band_deg = np.degrees(3 * SIGMA[2])
    assert -2 * band_deg < low < -band_deg < band_deg < high < 2 * band_deg


def test_the_newest_band_is_shown_whole():
    history = History()
    for frame in range(300):
        history.add(update(frame, sigma=SIGMA * (100 if frame == 299 else 1)))
    low, high = history.figure().axes[0].get_ylim()
    band_deg = np.degrees(300 * SIGMA[2])
    assert low <= -band_deg
    assert high >= band_deg


def test_a_step_of_the_camera_is_shown_whole():
    history = History()
    for frame in range(300):
        history.add(update(frame, {"left": np.full(6, 0.1 * (frame < 20))}))
    top_deg = max(float(np.max(line.get_ydata())) for line in history.figure().axes[0].lines)
    assert history.figure().axes[0].get_ylim()[1] > top_deg


def test_a_camera_s_event_is_in_its_row_and_the_lidar_s_in_all():
    xis = {"left": np.zeros(6), "right": np.zeros(6)}
    expected = [
        Event("moved", "right", 20, 22),
        Event("moved", None, 50, 52),
        Event("started", "left", 0, 0),
    ]
    history = History()
    for frame in range(100):
        events = [e for e in expected if e.detected_frame == frame]
        history.add(update(frame, xis, events=events))
    rows = np.reshape(history.figure().axes, (2, 2))
    for panel in rows[0]:
        assert texts(panel) == ["LiDAR moved"]
    for panel in rows[1]:
        assert sorted(texts(panel)) == ["LiDAR moved", "moved"]


def test_the_legend_is_drawn_once_and_names_the_kinds_that_occurred():
    history = History()
    for frame in range(100):
        found = [Event("blind", "left", 20, 40)] if frame == 40 else []
        history.add(update(frame, events=found))
    figure = history.figure()
    assert all(panel.get_legend() is None for panel in figure.axes)
    (legend,) = figure.legends
    legend_text = " ".join(text.get_text() for text in legend.get_texts())
    assert "blind" in legend_text
    assert "moved" not in legend_text


def test_labels_of_crowded_events_do_not_overlap():
    history = History()
    for frame in range(100):
        kind = "blind" if frame % 2 else "back"
        history.add(update(frame, events=[Event(kind, "left", frame, frame)]))
    figure = history.figure()
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) > 10
    for one, other in itertools.combinations(boxes, 2):
        apart_x = max(one.x0 - other.x1, other.x0 - one.x1)
        # Text boxes have a line's height, which letters do not fill: two rows may touch.
        apart_y = max(one.y0 - other.y1, other.y0 - one.y1)
        assert apart_x >= 0 or apart_y >= -2


def test_the_title_states_the_frames_and_the_convention():
    history = drive(History(), 7, first=12)
    title = history.figure().get_suptitle()
    assert "12 to 18" in title
    assert "p_camera = T_camera_lidar * p_lidar" in title


@pytest.mark.parametrize("updates", [0, 1])
def test_with_nothing_to_draw_the_picture_is_a_sentence(tmp_path: Path, updates: int):
    history = drive(History(), updates)
    history.draw(tmp_path / "history.png")
    assert read(tmp_path / "history.png").shape[1] == 1600
    assert not history.figure().axes
    assert "Nothing to draw" in history.figure().texts[0].get_text()


@pytest.mark.parametrize("cameras", [1, 4])
def test_the_picture_has_two_panels_per_camera_and_is_1600_pixels_wide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cameras: int
):
    xis = {f"camera_{place}": np.zeros(6) for place in range(cameras)}
    history = History()
    for frame in range(3):
        history.add(update(frame, xis))
    figure = history.figure()
    assert len(figure.axes) == 2 * cameras
    monkeypatch.setattr(history, "figure", lambda: figure)  # it takes a second to make
    history.draw(tmp_path / "history.png")
    picture = read(tmp_path / "history.png")
    assert picture.shape[1] == 1600
    assert picture.std() > 0


def test_timestamps_as_frame_numbers_are_drawn_to_the_frame():
    first = 1_700_000_000_000_000_000  # ns: a double holds such numbers to 256 only
    history = drive(History(), 10, first=first)
    panel = history.figure().axes[0]
    assert panel.get_xlim() == (0, 9)
    np.testing.assert_array_equal(panel.lines[0].get_xdata(), np.arange(10))
    assert str(first) in panel.get_xlabel()


def test_names_with_dollars_or_foreign_letters_and_long_ones_can_be_drawn(tmp_path: Path):
    xis = {name: np.zeros(6) for name in ("$a_{$", "前方", "long " * 20)}
    history = History()
    for frame in range(3):
        history.add(update(frame, xis))
    history.draw(tmp_path / "history.png")
    labels = [panel.get_ylabel() for panel in history.figure().axes]
    assert labels[0].startswith("$a_{$\n")
    assert max(map(len, labels)) < 50


def test_drawing_twice_gives_the_same_picture_and_changes_nothing(tmp_path: Path):
    history = drive(History(10), 35)
    history.draw(tmp_path / "one.png")
    history.draw(tmp_path / "two.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert kept_frames(history) == kept_frames(drive(History(10), 35))


def test_when_drawing_fails_the_old_picture_stays_and_nothing_is_left_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    history = drive(History(), 5)
    path = tmp_path / "history.png"
    history.draw(path)
    before = path.read_bytes()

    def fail(_: Figure, part: Path, **options: object) -> None:
        part.write_bytes(b"half a picture")
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        history.draw(path)
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]


def test_a_folder_in_the_picture_s_place_is_refused(tmp_path: Path):
    with pytest.raises(FileError, match="is a folder"):
        drive(History(), 5).draw(tmp_path)


def test_updates_of_another_rig_are_refused_and_change_nothing():
    history = drive(History(), 5)
    with pytest.raises(ValueError, match="frame 5: the update is of cameras"):
        history.add(update(5, {"right": np.zeros(6)}, events=[Event("moved", "right", 5, 5)]))
    assert len(history) == 5
    assert history.events == ()


def test_a_history_of_fewer_than_two_entries_is_refused():
    with pytest.raises(ValueError, match="at least 2"):
        History(1)
