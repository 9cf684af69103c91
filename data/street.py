# SPDX-License-Identifier: Apache-2.0
"""The street of the sample recording, straight and short, from the package's solids and paints."""

from dataclasses import replace

import numpy as np

from calibgraph.simulation.paints import (
    ASPHALT,
    BARK,
    BAY_M,
    COLOURS,
    FACADE,
    GRASS,
    KERB,
    KERB_Y_M,
    LEAFY,
    PAVING,
    ROAD,
    SLABS,
    STOREY_M,
)  # fmt: skip
from calibgraph.simulation.solids import (
    CAR,
    FURNITURE,
    HEDGE,
    PERSON,
    STRETCH_M,
    Solid,
    box,
    place,
)  # fmt: skip

GROUND_M, STREET_M = (240.0, 160.0), 92.0
PAVEMENT_M, PARKED = 3.4, 0.6
GROUND_PAINT = replace(ROAD, origin_m=(GROUND_M[0] / 2, GROUND_M[1] / 2))
STRETCH = (  # of pavement with its furniture and the grass behind, from the kerb outwards along y
    box((0, 0.08, 0), (STRETCH_M, 0.16, 0.15), KERB),
    box((0, 0.16 + PAVEMENT_M / 2, 0), (STRETCH_M, PAVEMENT_M, 0.14), PAVING, SLABS),
    box((0, 0.16 + PAVEMENT_M + 8, 0), (STRETCH_M, 16, 0.1), GRASS, LEAFY),
    *FURNITURE,
)


def street(rng: np.random.Generator) -> list[Solid]:
    """Compose the street: it runs along x from -16 m to 92 m and ends at a building."""
    solids = [box((0, 0, -1), (*GROUND_M, 1), ASPHALT, GROUND_PAINT)]
    solids.append(box((STREET_M + 12, 0, 0), (8, 16 * BAY_M, 9), COLOURS[1], FACADE))
    for x, y, yaw in ((47.0, -1.7, 1), (60, -1.9, -2), (14, 1.8, 180), (33, 1.7, 178)):
        solids += place(CAR, (x, y), yaw_deg=yaw, body=COLOURS[rng.integers(len(COLOURS))])
    for side, yaw_deg, gap_x in ((1, 0, 42.0), (-1, 180, 28.0)):
        solids += place(HEDGE, (gap_x, side * (KERB_Y_M + PAVEMENT_M)), yaw_deg=yaw_deg, body=BARK)
        x = -16.0
        while x < STREET_M:
            size = BAY_M * rng.integers(3, 6), BAY_M * 4, STOREY_M * rng.integers(2, 5)
            y, middle = KERB_Y_M + PAVEMENT_M + rng.uniform(5.4, 6.8), x + size[0] / 2
            colour = COLOURS[rng.integers(len(COLOURS))]
            if abs(middle - gap_x) > size[0] / 2 + 4:
                solids.append(box((middle, side * y, 0), size, colour, FACADE))
            x += size[0]
        for x in np.arange(-5, STREET_M, STRETCH_M) + rng.uniform(-1, 1):
            colour, person = COLOURS[rng.integers(len(COLOURS))], rng.uniform((-5, 1), (5, 2.5))
            at = (x + person[0], side * (KERB_Y_M + person[1]))
            solids += place(STRETCH, (x, side * KERB_Y_M), yaw_deg=yaw_deg, body=colour)
            solids += place(PERSON, at, yaw_deg=0, body=colour)
        for x in np.arange(-9.0, STREET_M, 6.0)[rng.random(17) < PARKED]:
            colour, at = COLOURS[rng.integers(len(COLOURS))], (x + rng.normal(0, 0.3), side * 4.75)
            solids += place(CAR, at, yaw_deg=rng.normal(0, 2), body=colour)
    return solids
