"""The commands for learned matching: what is in a file of weights, and training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import JsonOption, SeedOption
from calibgraph.cli.terminal import progress_bar, terminal


def weights(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Weights, .tar or .safetensors.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Convert to this .safetensors file.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a file of CMRNext weights, say what is in it, and convert it to safetensors."""
    from calibgraph.matching.cmrnext import load_checkpoint

    with checked_arguments():
        if out is not None and out.suffix != ".safetensors":
            raise ValueError(f"--out {out}: the name must end in .safetensors")
    checkpoint = load_checkpoint(file)
    if out is not None:
        checkpoint.save_safetensors(out)
    if as_json:
        from calibgraph.report.as_json import print_json

        print_json(checkpoint.summary())
    else:
        from calibgraph.cli.tables import print_weights

        print_weights(terminal(), checkpoint.summary(), out)


def train(
    dataset: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="Folders with a trusted extrinsic: KITTI sequences, or datasets with a "
            "reference.yaml; they may be of different rigs.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Weights to write.")],
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATASET",
            help="Folder to validate on (up to 100 images), may come again. "
            "(default: the last fifth of each DATASET)",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="RIG", help="Trusted extrinsic, instead of the folders'.")
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="FILE", help="Fine-tune these weights; the network is theirs."
        ),
    ] = None,
    rotation_deg: Annotated[
        float | None, typer.Option(help="Largest perturbation per axis (default: 20).")
    ] = None,
    translation_m: Annotated[
        float | None, typer.Option(help="Largest perturbation per axis (default: 1.5).")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Optimizer steps in all (default: 100000).")
    ] = None,
    batch: Annotated[int | None, typer.Option(help="Samples per step (default: 4).")] = None,
    width: Annotated[
        int | None,
        typer.Option(help="Channels of the first layer (default: 64, as published)."),
    ] = None,
    fourier_levels: Annotated[
        int | None, typer.Option(help="Of the depth's encoding, -1: none (default: 12).")
    ] = None,
    reflectance: Annotated[
        bool | None,
        typer.Option("--reflectance", help="Show the network the LiDAR's intensity too."),
    ] = None,
    context: Annotated[
        str | None,
        typer.Option(metavar="lidar|rgb", help="What the context encoder reads (default: lidar)."),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Of the recurrent update (default: 12).")
    ] = None,
    crop_px: Annotated[
        str | None,
        typer.Option(
            metavar="HxW|none", help="Random crops, at full resolution (default: 320x960)."
        ),
    ] = None,
    half_resolution: Annotated[
        bool | None, typer.Option("--half-resolution", help="Halve the images.")
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option(help="Peak of the one-cycle (default: 3e-4).")
    ] = None,
    warm_up_share: Annotated[
        float | None, typer.Option(help="Of the steps, until that peak (default: 0.4).")
    ] = None,
    correlation_weight: Annotated[
        float | None,
        typer.Option(
            help="Of a loss on the correlation itself (default: 0; 0.3 for short trainings)."
        ),
    ] = None,
    correlation_steps: Annotated[
        int | None, typer.Option(help="Steps at first with that loss alone (default: 0).")
    ] = None,
    validate_every: Annotated[
        int, typer.Option(min=1, help="Steps; the weights are written then.")
    ] = 500,
    device: Annotated[str, typer.Option(metavar="auto|cpu|cuda", help="Of torch.")] = "auto",
    seed: SeedOption = 0,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on where FILE stopped, with the settings in it."),
    ] = False,
) -> None:
    """Train a CMRNext network by perturbing trusted extrinsics."""
    from calibgraph.cli.tables import print_validation
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.cmrnext import TrainSettings, train
    from calibgraph.matching.cmrnext.training.scenes import split, trusted_dataset
    from calibgraph.matching.cmrnext.training.settings import parsed_crop

    settings: dict[str, Any] = {
        "rotation_deg": rotation_deg,
        "translation_m": translation_m,
        "steps": steps,
        "batch": batch,
        "iterations": iterations,
        "learning_rate": learning_rate,
        "warm_up_share": warm_up_share,
        "correlation_weight": correlation_weight,
        "correlation_steps": correlation_steps,
        "crop_px": crop_px,
        "half_resolution": half_resolution,
        "width": width,
        "fourier_levels": fourier_levels,
        "reflectance": reflectance,
        "context": context,
        "seed": seed or None,
        "from": start,
    }
    given = {key: value for key, value in settings.items() if value is not None}
    with checked_arguments():
        if resume and given:
            option = next(iter(given)).replace("_", "-")
            raise ValueError(f"--{option}: --resume goes on with the settings in {out}; leave out")
        given.pop("from", None)
        if crop_px is not None:
            given["crop_px"] = parsed_crop(crop_px)
        chosen = TrainSettings().changed(**given)
    trusted = load_rig(rig) if rig else None
    data = [trusted_dataset(folder, trusted) for folder in dataset]
    if held_out:
        others = [trusted_dataset(folder, trusted) for folder in held_out]
    else:
        data, others = split(data)
    console = terminal()
    with progress_bar() as progress, checked_arguments():
        train(
            data,
            others,
            out,
            None if resume else chosen,
            device=device,
            validate_every=validate_every,
            start=start,
            resume=resume,
            report=lambda validation: print_validation(console, validation),
            progress=progress,
        )
    console.print(f"{out}: trained", soft_wrap=True, markup=False)
