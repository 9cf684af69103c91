"""The commands of the learned matcher: what is in a file of weights, and training."""

from pathlib import Path
from typing import Annotated, Any

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import ConfigSeedOption, JsonOption
from calibgraph.cli.terminal import print_json, progress_bar, terminal


def weights(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Weights, .tar or .safetensors.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Convert to this .safetensors file.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a file of CMRNext weights, print what is in it, and convert it to safetensors."""
    from calibgraph.matching.cmrnext import load_checkpoint

    checkpoint = load_checkpoint(file)
    if out is not None:
        checkpoint.save_safetensors(out)
    if as_json:
        print_json(checkpoint.summary())
    else:
        from calibgraph.cli.tables import print_weights

        print_weights(terminal(), checkpoint.summary(), out)


def _print_settings_option(module: str, settings: str) -> Any:
    """``--print-settings`` of a training, whose settings are a model of that name in a module."""

    def print_settings(requested: bool) -> None:
        if requested:
            from importlib import import_module

            from calibgraph.files import commented_defaults

            print(commented_defaults(getattr(import_module(module), settings)))
            raise typer.Exit

    return typer.Option(
        "--print-settings",
        callback=print_settings,
        is_eager=True,
        help="Print a settings file with all defaults and what they mean, and exit.",
    )


def train(
    dataset: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="Folders with a trusted extrinsic: KITTI sequences, datasets with a "
            "reference.yaml, or results, whose PASS cameras count; they may be of different "
            "rigs.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Weights to write; their settings are written beside."),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Settings of the training, YAML. (default: the published training's)",
        ),
    ] = None,
    print_settings: Annotated[
        bool, _print_settings_option("calibgraph.matching.cmrnext", "TrainSettings")
    ] = False,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATASET",
            help="Folder to validate on (up to 100 images); may be repeated. "
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
    validate_every: Annotated[
        int, typer.Option(min=1, help="Steps between validations; each writes the weights.")
    ] = 500,
    device: Annotated[str, typer.Option(metavar="auto|cpu|cuda", help="Torch device.")] = "auto",
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed, instead of the settings' one.")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue the training that wrote FILE, with its settings."),
    ] = False,
) -> None:
    """Train a CMRNext network by perturbing trusted extrinsics."""
    from calibgraph.cli.tables import print_validation
    from calibgraph.files import load_model
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.cmrnext import TrainSettings, train
    from calibgraph.matching.trusted_data import load_held_out, load_trusted_dataset, split

    given = {"config": config, "seed": seed, "from": start}
    with checked_arguments():
        for option, value in given.items():
            if resume and value is not None:
                raise ValueError(
                    f"--{option}: --resume goes on with the settings in {out}; leave out"
                )
        own = {} if seed is None else {"seed": seed}
        chosen = load_model(TrainSettings, config, **own)
    trusted = load_rig(rig) if rig else None
    data = [load_trusted_dataset(folder, trusted) for folder in dataset]
    if held_out:
        others = load_held_out(held_out, data, trusted)
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


def train_windows(
    recording: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT...",
            help="Results of calibrate, whose frames and PASS cameras are learned from; or KITTI "
            "sequences or datasets with a reference.yaml.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE.json", help="Weights to write, if recordings held out get better."
        ),
    ],
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the training, YAML.")
    ] = None,
    print_settings: Annotated[
        bool,
        _print_settings_option("calibgraph.matching.structure.training", "WindowSettings"),
    ] = False,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RESULT",
            help="Recording that only measures whether the weights are better; may be repeated. "
            "(default: the last fifth of each RESULT)",
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Weights to begin with. (default: shipped)"),
    ] = None,
    seed: ConfigSeedOption = None,
) -> None:
    """Train the weights of the matcher structure's windows on the poses of your own recordings.

    If recordings held out get no better, nothing is written, and the exit code is 2.
    """
    from calibgraph.errors import CalibrationError
    from calibgraph.files import load_model
    from calibgraph.matching.structure.training import WindowSettings, train_windows
    from calibgraph.matching.structure.window_weights import load_window_network
    from calibgraph.matching.trusted_data import load_held_out, load_trusted_dataset, split

    chosen = load_model(WindowSettings, config, **({} if seed is None else {"seed": seed}))
    begun = None if start is None else load_window_network(start)
    data = [load_trusted_dataset(folder) for folder in recording]
    others = load_held_out(held_out or (), data)
    if not others:
        data, others = split(data)
    with progress_bar() as progress:
        found = train_windows(data, others, chosen, start=begun, progress=progress)
    before, after = found.held_out
    if not after < before:
        raise CalibrationError(
            f"{out}: is not written: recordings held out get no better ({_change(found.held_out)}, "
            "negative log-likelihood of a camera's pose); learn from more recordings, or keep the "
            "weights that you have"
        )
    found.network.save(out)
    terminal().print(
        f"{out}: negative log-likelihood of a camera's pose {_change(found.loss)}, held out "
        f"{_change(found.held_out)} ({_of_cameras(found.held_out_cameras, found.standard_error)})",
        soft_wrap=True, markup=False,
    )  # fmt: skip


def _change(values: tuple[float, float]) -> str:
    return f"{values[0]:.3f} -> {values[1]:.3f}"


def _of_cameras(count: int, standard_error: float) -> str:
    if count == 1:
        return "one camera: hold out more to know whether it holds"
    return f"mean over {count} cameras, its change known to +- {standard_error:.3f}"
