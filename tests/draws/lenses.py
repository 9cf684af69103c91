"""Rigs whose lenses are wrong in one way."""

from calibgraph.model.config import LensPart
from calibgraph.model.rig import IntrinsicsSigma, Rig

_EXACT = {
    "intrinsics_sigma_px": IntrinsicsSigma(focal=1e-4, centre=1e-4), "distortion_sigma": 1e-7
}  # fmt: skip
_K1 = {"pinhole": 0, "fisheye": 0, "omnidirectional": 1}  # where it stands


def put_lens_error(rig: Rig, part: LensPart, error: float) -> Rig:
    """The rig with one part of all lenses wrong, and the same extrinsics.

    Args:
        rig: its lenses are the truth.
        part: which.
        error: relative, of ``focal`` and ``aspect``; of cx [px], of ``centre``; of k1.
    """
    cameras = {}
    for name, camera in rig.cameras.items():
        k, distortion = camera.intrinsics_px, [*camera.distortion] or [0.0] * 4
        update: dict[str, object] = {}
        if part == "distortion":
            distortion[_K1[camera.model]] += error
            update["distortion"] = tuple(distortion)
        wrong = {
            "focal": {"fx": k.fx * (1 + error), "fy": k.fy * (1 + error)},
            "aspect": {"fx": k.fx * (1 + error)},
            "centre": {"cx": k.cx + error},
        }
        update["intrinsics_px"] = k.model_copy(update=wrong.get(part, {}))
        cameras[name] = camera.model_copy(update=update)
    return rig.model_copy(update={"cameras": cameras})


def with_known_lenses(rig: Rig) -> Rig:
    """The rig that states its lenses to be known exactly: the bar of a mount leaves them out."""
    return with_fields(rig, **_EXACT)


def with_fields(rig: Rig, **fields: object) -> Rig:
    """The rig with these fields of every camera."""
    cameras = {name: camera.model_copy(update=fields) for name, camera in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})
