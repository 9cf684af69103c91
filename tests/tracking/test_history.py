from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph import Event, Update
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


def test_curves_end_at_zero_and_bring_the_newest_estimate_to_the_older_ones():
    rng = np.random.default_rng(0)
    xis = 0.1 * rng.standard_normal((5, 6))
    history = History()
    for frame, xi in enumerate(xis):
        history.add(update(frame, {"left": xi}))
    (curve, sigma) = history.curves()[1]["left"]
    np.testing.assert_allclose(curve[-1], 0, atol=1e-12)
    np.testing.assert_allclose(sigma, np.tile(SIGMA, (5, 1)))
    for xi, difference in zip(xis, curve, strict=True):
        np.testing.assert_allclose(
            (gtsam.Pose3.Expmap(difference) * gtsam.Pose3.Expmap(xis[-1])).matrix(),
            gtsam.Pose3.Expmap(xi).matrix(),
            atol=1e-12,
        )


def test_the_history_of_a_long_drive_is_thinned_evenly_and_ends_with_the_newest():
    history = History(most=20)
    for frame in range(3000):
        history.add(update(frame, events=[Event("moved", "left", frame, frame)]))
    numbers, _ = history.curves()
    assert len(numbers) <= 21 and numbers[-1] == 2999
    assert {*np.diff(numbers[:-1])} == {256}
    assert len(history.events) == 1000


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
        expected = unit * (xi[rows, None] + SIGMA[rows, None] * [-3.0, 3.0, 0.0])
        np.testing.assert_allclose(drawn.reshape(3, 3), expected, atol=1e-9)


def test_names_with_dollars_or_foreign_letters_and_long_ones_can_be_drawn(tmp_path: Path):
    xis = {name: np.zeros(6) for name in ("$a_{$", "前方", "long " * 20)}
    history = History()
    for frame in range(3):
        history.add(update(frame, xis))
    history.draw(tmp_path / "history.png")
    labels = [panel.get_ylabel() for panel in history.figure().axes]
    assert labels[0].startswith("$a_{$\n")
    assert max(map(len, labels)) < 50
