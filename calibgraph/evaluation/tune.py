"""The paper's random search for lambda, mu, delta and tau, tested on other draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.evaluation.paper import draw_seed
from calibgraph.evaluation.sources import Draw, Source
from calibgraph.files import write_yaml
from calibgraph.model.config import Config, preset
from calibgraph.model.metrics import evaluate
from calibgraph.outputs import yaml_mark
from calibgraph.progress import Progress, no_progress
from calibgraph.solver.joint import solve_joint

UNIT_DEG, UNIT_CM = 1.0, 10.0
"""Errors that contribute 1 to the score."""


@dataclass(frozen=True)
class Candidates:
    """The values to search, per setting.

    Attributes:
        prior_weight: lambda.
        relative_prior_weight: mu.
        loss_scale_px: delta.
        gate_px: tau.
    """

    prior_weight: tuple[float, ...] = (0, 0.1, 0.5, 1, 2, 5, 10)
    relative_prior_weight: tuple[float, ...] = (0, 1, 2, 5, 10, 20)
    loss_scale_px: tuple[float, ...] = (1, 2, 4, 8, 16)
    gate_px: tuple[float, ...] = (2, 3, 5, 8, 16, 32)

    def sample(self, base: Config, count: int, seed: int) -> list[Config]:
        """That many different combinations at random, or all if there are fewer.

        Raises:
            ValueError: if a set is empty or a value is out of range.
        """
        names = list(vars(self))
        combinations = list(product(*vars(self).values()))
        if not combinations or count < 1:
            raise ValueError(
                "nothing to search: a set of candidates is empty, or the number of samples is 0"
            )
        order = np.random.default_rng(seed).permutation(len(combinations))[:count]
        return [base.changed(**dict(zip(names, combinations[i], strict=True))) for i in order]


@dataclass(frozen=True)
class ScoredConfig:
    """Settings and their scores; infinite if a solve failed.

    Attributes:
        name: for tables.
        config: the settings.
        tuning: score on the draws of the search.
        test: score on other draws; None if it was not measured.
    """

    name: str
    config: Config
    tuning: float
    test: float | None = None


@dataclass(frozen=True)
class TuningResult:
    """The result of the search.

    Attributes:
        best: the best candidate.
        others: the paper's settings and ``auto``, on the same draws.
        tried: all candidates, best first.
    """

    best: ScoredConfig
    others: tuple[ScoredConfig, ...]
    tried: tuple[ScoredConfig, ...]

    def to_mapping(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        rows = (self.best, *self.others)
        return {
            "settings": _searched_settings(self.best.config),
            "scores": {row.name: {"tuning": row.tuning, "test": row.test} for row in rows},
            "tried": [
                {**_searched_settings(row.config), "tuning": row.tuning} for row in self.tried
            ],
        }

    def save(self, path: Path) -> None:
        """Write the best candidate as a settings file for ``--config``."""
        settings = {"preset": self.best.config.preset, **_searched_settings(self.best.config)}
        write_yaml(path, settings, first_line=yaml_mark("tune"))


def _searched_settings(config: Config) -> dict[str, float]:
    return {name: getattr(config, name) for name in vars(Candidates())}


def tune(
    source: Source,
    *,
    base: Config,
    frames: int,
    samples: int = 50,
    draws: int = 5,
    candidates: Candidates | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> TuningResult:
    """Search for settings at random on some draws, and test the best on others.

    The paper minimizes "a combined rotation-and-translation error"; here that is :func:`score`.
    The solver is ours, which converges to the same optimum as the paper's.

    Args:
        source: its tuning and test draws share no frame.
        base: settings that are not searched.
        frames: per draw.
        samples: number of candidates.
        draws: for tuning, and as many for the test.
        candidates: the values to search.
        seed: of everything random.
        progress: called with the number of candidates done.

    Raises:
        ValueError: if there is nothing to search.
    """
    configs = (candidates or Candidates()).sample(base, samples, seed)
    halves = [_draw_all(half, frames, draws, seed) for half in source.halves(seed)]
    tried = []
    for index, config in enumerate(configs):
        progress("candidates", index, len(configs))
        tried.append(ScoredConfig("candidate", config, score(halves[0], config)))
    tried.sort(key=lambda scored: scored.tuning)
    best = tried[0]
    tested = ScoredConfig("best", best.config, best.tuning, score(halves[1], best.config))
    return TuningResult(tested, _score_references(base, halves), tuple(tried))


def _score_references(base: Config, halves: Sequence[Sequence[Draw]]) -> tuple[ScoredConfig, ...]:
    """The paper's settings and ``auto``, on the draws for tuning and on those for the test."""
    others = {f"the paper's ({base.preset})": base, "auto": preset("auto").changed(seed=base.seed)}
    return tuple(
        ScoredConfig(name, config, *(score(half, config) for half in halves))
        for name, config in others.items()
    )


def score(draws: Sequence[Draw], config: Config) -> float:
    """E_R / 1 deg + E_t / 10 cm of the full method, the mean over cameras and draws."""
    return float(np.mean([_error(draw, config) for draw in draws]))


def _error(draw: Draw, config: Config) -> float:
    """Score of one draw: the mean over its cameras; infinite if the solve failed."""
    stage1 = None
    if draw.matched:
        config = config.changed(stage1="rig")
    else:
        stage1 = draw.stage1(config)
    try:
        solved = solve_joint(draw.rig, draw.table, config, pairwise=stage1).solved_rig
    except CorrespondenceError:
        return math.inf
    errors = evaluate(solved, next(iter(draw.references.values()))).cameras.values()
    return float(
        np.mean([
            e.rotation_error_deg / UNIT_DEG + e.translation_error_cm / UNIT_CM for e in errors
        ])
    )  # fmt: skip


def _draw_all(source: Source, frames: int, draws: int, seed: int) -> list[Draw]:
    return [source.draw(frames, draw_seed(seed, frames, index)) for index in range(draws)]
