"""Simulated rigs with a matcher, drawn at random, for the cases of ``accuracy.verdicts``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from calibgraph import (
    Calibration,
    Camera,
    Correspondences,
    Intrinsics,
    MatcherErrors,
    Rig,
    concatenate,
    perturb,
)
from tests.draws.cameras import camera_at
from tests.draws.drives import simulate_drive

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class Problem:
    """One case.

    Attributes:
        truth: the true rig.
        calibrate: runs calibgraph on its data.
        drawn: the numbers that were drawn, for the results file.
    """

    truth: Rig
    calibrate: Callable[[], Calibration]
    drawn: dict[str, Any]


@dataclass(frozen=True, eq=False)
class World:
    """A true rig, its matcher's errors, and the guess's."""

    truth: Rig
    frames: int
    matches: int
    errors: MatcherErrors
    depth_m: tuple[float, float]
    guess_deg: float
    guess_m: float
    seed: int

    @staticmethod
    def draw(rig: Rig, rng: Rng) -> World:
        """Draw frames, matches, errors and guess."""
        seed = int(rng.integers(2**31))
        return World(
            truth=perturb(rig, rotation_deg=5, translation_m=0.1, seed=seed, uniform=True),
            frames=int(rng.integers(5, 41)),
            matches=int(np.exp(rng.uniform(np.log(50), np.log(500)))),
            errors=MatcherErrors(
                noise_px=rng.uniform(0.5, 2.0),
                frame_noise_px=rng.uniform(0.0, 1.5),
                outlier_share=rng.uniform(0.0, 0.3),
                informative_confidence=bool(rng.random() < 0.5),
            ),
            depth_m=(3.0, rng.uniform(20.0, 60.0)),
            guess_deg=rng.uniform(0.0, 20.0),
            guess_m=rng.uniform(0.0, 1.5),
            seed=seed,
        )

    def guess(self) -> Rig:
        """The truth, displaced."""
        return perturb(
            self.truth, rotation_deg=self.guess_deg, translation_m=self.guess_m, seed=self.seed + 1
        )

    def table(self, rig_at: Callable[[int], Rig] | None = None) -> Correspondences:
        """Its matcher's table; ``rig_at`` as of :func:`simulate_drive`, the truth if None."""
        return concatenate(
            list(
                simulate_drive(
                    rig_at or (lambda frame: self.truth),
                    frames=self.frames,
                    matches=self.matches,
                    errors=self.errors,
                    depth_m=self.depth_m,
                    seed=self.seed + 2,
                )
            )
        )

    @property
    def data(self) -> Correspondences:
        """The table of the truth."""
        return self.table()

    def drawn(self) -> dict[str, Any]:
        """All numbers but the rig."""
        values = {k: v for k, v in vars(self).items() if k not in ("truth", "errors")}
        return {**values, **asdict(self.errors)}


def rigs() -> dict[str, Rig]:
    """The rigs, by name."""
    kitti = partial(_camera, size=(1241, 376), focal=719.0)
    wide = partial(_camera, size=(1920, 1200), focal=1450.0)
    side = partial(_camera, size=(1936, 1216), focal=1060.0)
    fish = partial(_camera, size=(1280, 960), focal=330.0, model="fisheye")
    return {
        "pair": Rig(cameras={"left": kitti((0.3, 0.27, -0.1)), "right": kitti((0.3, -0.27, -0.1))}),
        "wide_pair": Rig(
            cameras={
                "left": wide((0.5, 0.4, -0.3), distortion=(-0.11, 0.05, 0.001, -0.002, 0.004)),
                "right": wide((0.5, -0.4, -0.3), distortion=(-0.12, 0.06, -0.001, 0.001, 0.003)),
            }
        ),
        "surround": Rig(
            cameras={f"camera_{k}": side(_on_ring(k * 60, 0.8), yaw_deg=k * 60) for k in range(6)}
        ),
        "fisheyes": Rig(
            cameras={
                f"fisheye_{k}": fish(
                    _on_ring(k * 90, 1.0), yaw_deg=k * 90, distortion=(0.02, -0.004, 0.001, -0.0002)
                )
                for k in range(4)
            }
        ),
    }


def _camera(
    position_m: tuple[float, ...], *, size: tuple[int, int], focal: float, **others: Any
) -> Camera:
    width, height = size
    lens = Intrinsics(fx=focal, fy=0.995 * focal, cx=0.492 * width, cy=0.496 * height)
    return camera_at(size, lens, position_m, **others)


def _on_ring(angle_deg: float, radius_m: float) -> tuple[float, float, float]:
    angle = np.radians(angle_deg)
    return (radius_m * np.cos(angle), radius_m * np.sin(angle), -0.3)


RIGS = rigs()
