"""The sources of the error bars at the end of a drive, by the graph of all its places."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.error_sources import ErrorSources
from calibgraph.solver.error_model import ErrorFit
from calibgraph.solver.sources import (
    predict_variances,
    sources_by_camera,
    variances_by_source,
)
from calibgraph.tracking.closed_places import ClosedPlaces
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.state import State


def error_sources(state: State, joint: Array | None) -> dict[str, ErrorSources]:
    """Per camera, the shares of its error bar.

    None without error bars of all cameras, and where a camera drifts: then the graph of the places
    is not the whole.

    Args:
        state: of the tracker.
        joint: (6 N, 6 N) the reported covariance.
    """
    if joint is None or state.drifting:
        return {}
    whole = changed(state, epochs=(*state.epochs, changed(state.epochs[-1], frames=())))
    errors = ErrorFit(ClosedPlaces.of(whole).fit, (), state.sizes)
    total = np.minimum(np.diag(errors.fit.covariance), np.diag(joint))
    parts, forecast = variances_by_source(errors), predict_variances(errors)
    numbers = {name: number for number, name in enumerate(state.names)}
    return sources_by_camera(joint, total, parts, forecast, numbers=numbers)
