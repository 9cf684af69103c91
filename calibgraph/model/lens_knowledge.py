"""How well a lens is known, by how it is known: one table for rigs that are written and solved."""

from typing import NamedTuple

from calibgraph.model.rig import Camera, IntrinsicsSigma, Rig


class LensSigmas(NamedTuple):
    """Standard deviations of a lens where the rig states none.

    Of the logarithm of both focal lengths, of each coordinate of the centre [px],
    and of radial coefficients; tangential ones have ``TANGENTIAL_SHARE`` of these.
    """

    focal: float
    centre_px: float
    radial: float

    @staticmethod
    def calibrated(camera: Camera) -> "LensSigmas":
        """Of a lens that was calibrated with a target: 0.2 %; of 1000 px, a centre to 2 px."""
        share = _CALIBRATED
        return LensSigmas(share, share * camera.intrinsics_px.fx, share)

    def state_in(self, camera: Camera) -> Camera:
        """A camera with these sigmas, unless it states its own."""
        if camera.intrinsics_sigma_px is not None or camera.model == "equirectangular":
            return camera
        focal_px = round(self.focal * camera.intrinsics_px.fx, 2)
        sigma = IntrinsicsSigma(focal=focal_px, centre=round(self.centre_px, 2))
        radial = camera.distortion_sigma or self.radial
        return camera.model_copy(update={"intrinsics_sigma_px": sigma, "distortion_sigma": radial})


IN_DOUBT = LensSigmas(0.02, 5.0, 0.05)
"""Of a lens that is estimated, or known from words, a spec sheet or a field of view."""
_CALIBRATED = 0.002


def state_calibrated(rig: Rig) -> Rig:
    """A rig whose lenses are from a calibration, with the sigmas of one where it states none."""
    cameras = {n: LensSigmas.calibrated(c).state_in(c) for n, c in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def describe_unstated(rig: Rig) -> str:
    """The cameras whose lens has no stated sigma, in a clause; empty without any."""
    names = [
        name
        for name, camera in rig.cameras.items()
        if camera.intrinsics_sigma_px is None and camera.model != "equirectangular"
    ]
    if not names:
        return ""
    return (
        f"lens of {', '.join(names)}: counts as calibrated (the rig states no intrinsics_sigma_px)"
    )
