"""The correspondences and camera pairs of a solve, sorted by place."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.by_place import BlockByPlace, PairByPlace, place_of
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_pairs import PairTerm, usual_excess
from calibgraph.solver.residual_scale import ResidualScale

Numbers = NDArray[np.int64]


def block_by_place(
    camera: CameraBlock, scale: ResidualScale, places: Sequence[Numbers]
) -> BlockByPlace:
    """The correspondences of a camera, sorted by place.

    Args:
        camera: its correspondences.
        scale: of their residuals.
        places: the frame numbers of each place.
    """
    of_frame, counts = place_of(camera.frame_numbers, places), camera.frame_counts
    if len(places) == 1:
        return BlockByPlace(camera.with_scale(scale), np.array([0, len(camera)]), of_frame, counts)
    edges = np.zeros(len(places) + 1, dtype=np.int64)
    np.add.at(edges[1:], of_frame, counts)
    block = camera.sorted_by(of_frame).with_scale(scale)
    return BlockByPlace(block, edges.cumsum(), of_frame, counts)


def pairs_by_place(pairs: Sequence[PairTerm], places: Sequence[Numbers]) -> list[PairByPlace]:
    """Each term with the information of features that err as usual in a frame."""
    found = []
    for pair in pairs:
        own = [one for one in pairs if {one.a, one.b} == {pair.a, pair.b}]
        term = pair.deflate(usual_excess(own))
        of_row = place_of(term.frame, places)
        rows = np.argsort(of_row, kind="stable")
        present, first = np.unique(of_row[rows], return_index=True)
        edges = np.append(first, len(rows))
        found.append(PairByPlace(term.a, term.b, term.block.select(rows), present, edges))
    return found
