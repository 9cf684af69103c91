"""The lens and the clock of a camera as a variable of the graph, shared by all its places.

    prior    l_c at the lens of the rig, each parameter with a Cauchy loss
    matcher  l_c to s_c, the lens as the matches show it, displaced by the scan distortion and by
             their errors; these displace m_c, the pose as they show it, too
    data     correspondences of camera c at place p, on o_p, a_cp and s_c

A parameter of l_c is in standard deviations of its prior. The prior has heavy tails: data that are
sure of a wrong lens leave it, and data that are not stay with it.

The clock is among them: the ``offset`` of the middle row of an image to the points of its frame,
and the ``readout`` from the first row to the last. Matches show them where the LiDAR moves: its
twist comes with the correspondences. Constant motion straight ahead shows no offset, which is then
a translation; at rest the columns are zero, and the parameters stay at their prior.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.variables import DISTORTION, lens_key, seen_lens_key
from calibgraph.model.clock import clock_of
from calibgraph.model.config import LensPart
from calibgraph.model.lens import IN_DOUBT, LensSigmas
from calibgraph.model.rig import Camera, Rig
from factors import Columns, cauchy_noise, linear_factor
from factors.columns import CENTRE_X, CENTRE_Y, CLOCK, COEFFICIENT_NUMBERS, FOCAL, OFFSET, READOUT
from factors.lens_kernels import PINHOLE

TANGENTIAL_SHARE = 0.1
_TAIL_SIGMAS = 2.0  # where the Cauchy loss of a prior bends
_PLAIN = 2  # radial coefficients that are set free in a rig without distortion
_EXACT = 1e-3  # prior standard deviations: less would lose digits


@dataclass(frozen=True, eq=False)
class LensVariable:
    """One camera's lens and clock.

    Attributes:
        camera: with the lens at the prior's mean.
        free: its free parameters.
        values: (k,) at which the correspondences have been weighed and gated.
    """

    camera: Camera
    free: Columns
    values: Array

    @staticmethod
    def of(
        camera: Camera, parts: Iterable[LensPart], default: LensSigmas = IN_DOUBT
    ) -> LensVariable:
        """The lens of a camera, at its prior.

        Args:
            camera: of the rig, with the sigmas that it states.
            parts: which are free.
            default: sigmas where the rig states none.

        Raises:
            ValueError: if its model has no such part.
        """
        sigmas = _prior_sigmas(camera, default)
        chosen = {name: sigma for part in parts for name, sigma in sigmas[part].items()}
        free = Columns(camera.lens, tuple(chosen), tuple(chosen.values()), clock_of(camera))
        return LensVariable(camera, free, np.zeros(len(chosen)))

    @property
    def has_free_lens(self) -> bool:
        """Whether more than the clock is free."""
        return not {*self.free.parameters} <= {*CLOCK}

    def moved_to(self, values: Array) -> LensVariable:
        """The same variable, where correspondences are weighed and gated at other values."""
        return replace(self, values=values)

    def put_into(self, camera: Camera, values: Array) -> Camera:
        """A camera with the lens and clock of (k,) values."""
        clock = self.free.clock_at(values)
        times = {OFFSET: ("time_offset_s", clock.offset_s), READOUT: ("readout_s", clock.readout_s)}
        camera = camera.model_copy(
            update=dict(times[n] for n in self.free.parameters if n in times)
        )
        if not self.has_free_lens:
            return camera
        packed = self.free.at(values).packed
        intrinsics = dict(zip(("fx", "fy", "cx", "cy"), packed[:4].tolist(), strict=True))
        numbers = COEFFICIENT_NUMBERS[self.free.lens.kind]
        free = any(name in numbers for name in self.free.parameters)
        size = max(len(self.camera.distortion), 4 if free else 0)
        return camera.model_copy(
            update={
                "intrinsics_px": camera.intrinsics_px.model_copy(update=intrinsics),
                "distortion": tuple(packed[4 : 4 + size].tolist()),
            }
        )


def _prior_sigmas(camera: Camera, default: LensSigmas) -> dict[LensPart, dict[str, float]]:
    """Per part of a lens, the prior standard deviation of each parameter."""
    stated, kind = camera.intrinsics_sigma_px, camera.lens.kind
    focal = default.focal
    if stated is not None and stated.focal is not None:
        focal = stated.focal / camera.intrinsics_px.fx
    centre = default.centre_px if stated is None or stated.centre is None else stated.centre
    radial = camera.distortion_sigma or default.radial
    size = len(camera.distortion) or _PLAIN
    return {
        "focal": {FOCAL: focal},
        "centre": {CENTRE_X: centre, CENTRE_Y: centre},
        "distortion": {
            name: radial if name[0] == "k" else TANGENTIAL_SHARE * radial
            for name, number in COEFFICIENT_NUMBERS[kind].items()
            if kind != PINHOLE or number < size
        },
        "offset": {OFFSET: camera.time_offset_sigma_s or default.offset_s},
        "readout": {READOUT: camera.readout_sigma_s or default.readout_s},
    }


def lens_variables(rig: Rig, parts: Sequence[LensPart]) -> dict[str, LensVariable]:
    """Per camera its variable."""
    return {name: LensVariable.of(camera, parts) for name, camera in rig.cameras.items()}


@dataclass(frozen=True, eq=False)
class LensTerm:
    """A lens in the error model.

    Attributes:
        variable: the lens.
        excess: (k, k) covariance of s_c about l_c, in the units of the values.
        by_distortion: (k, B) displacement of s_c by a unit of each scan distortion.
        compensating: (6, k) displacement of m_c by a unit of the difference of s_c and l_c that is
            no scan distortion: of the pose that fits best where the lens is wrong by as much.
    """

    variable: LensVariable
    excess: Array
    by_distortion: Array
    compensating: Array

    def displace(self, number: int, shifts: Mapping[int, Array]) -> dict[int, Array]:
        """By key, the (6, ...) displacements of m_c, with those by l_c and s_c."""
        B = self.compensating
        bent = {key: shift - B @ self.by_distortion for key, shift in shifts.items()}
        return {lens_key(number): -B, seen_lens_key(number): B, **bent}


def lens_graph(lenses: Mapping[int, LensTerm], *, is_distorted: bool) -> gtsam.NonlinearFactorGraph:
    """Priors of the lenses, and from each to where its matches show it."""
    graph = gtsam.NonlinearFactorGraph()
    tail = cauchy_noise(gtsam.noiseModel.Unit.Create(1), _TAIL_SIGMAS)
    for number, term in lenses.items():
        unit = np.eye(len(term.variable.free))
        for row in unit:
            graph.add(linear_factor([lens_key(number)], [row[None]], tail))
        keys, matrices = [lens_key(number), seen_lens_key(number)], [-unit, unit]
        if is_distorted:
            keys, matrices = [*keys, DISTORTION], [*matrices, -term.by_distortion]
        noise = gtsam.noiseModel.Gaussian.Covariance(term.excess + _EXACT**2 * unit)
        graph.add(linear_factor(keys, matrices, noise))
    return graph
