"""The commands of the learned matcher: what is in a file of weights, and training."""

from pathlib import Path
from typing import Annotated, Any

import typer

from calibgraph.cli import outputs
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import ConfigSeedOption, JsonOption
from calibgraph.cli.terminal import print_json, progress_bar, terminal


def weights(
    file: Path,
    out: Annotated[Path | None, outputs.WEIGHTS] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a file of CMRNext weights, print what is in it, and convert it to safetensors.

    Args:
        file (FILE): Weights, .tar or .safetensors.
        out (FILE): Convert to this .safetensors file.
    """
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
    dataset: list[Path],
    out: Annotated[Path, typer.Option(), outputs.TRAINING],
    config: Path | None = None,
    print_settings: Annotated[
        bool, _print_settings_option("calibgraph.matching.cmrnext", "TrainSettings")
    ] = False,
    held_out: list[Path] | None = None,
    rig: Path | None = None,
    start: Annotated[Path | None, typer.Option("--from")] = None,
    validate_every: Annotated[int, typer.Option(min=1)] = 500,
    device: str = "auto",
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    resume: bool = False,
) -> None:
    """Train a CMRNext network by perturbing trusted extrinsics.

    Args:
        dataset (DATASET...): Folders with a trusted extrinsic: KITTI sequences, datasets with a
            reference.yaml, or results, whose PASS cameras count; they may be of different rigs.
        out (FILE): Weights to write; their settings are written beside.
        config (FILE): Settings of the training, YAML. (default: the published training's)
        held_out (DATASET): Folder to validate on (up to 100 images); may be repeated. (default: the
            last fifth of each DATASET)
        rig (RIG): Trusted extrinsic, instead of the folders'.
        start (FILE): Fine-tune these weights; the network is theirs.
        validate_every: Steps between validations; each writes the weights.
        device (auto|cpu|cuda): Torch device.
        seed: Seed, instead of the settings' one.
        resume: Continue the training that wrote FILE, with its settings.
    """
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
    recording: list[Path],
    out: Annotated[Path, typer.Option(), outputs.WINDOW_WEIGHTS],
    config: Path | None = None,
    print_settings: Annotated[
        bool,
        _print_settings_option("calibgraph.matching.structure.training", "WindowSettings"),
    ] = False,
    held_out: list[Path] | None = None,
    start: Annotated[Path | None, typer.Option("--from")] = None,
    seed: ConfigSeedOption = None,
) -> None:
    """Train the weights of the matcher structure's windows on the poses of your own recordings.

    If recordings held out get no better, nothing is written, and the exit code is 2.

    Args:
        recording (RESULT...): Results of calibrate, whose frames and PASS cameras are learned from;
            or KITTI sequences or datasets with a reference.yaml.
        out (FILE.json): Weights to write, if recordings held out get better.
        config (FILE): Settings of the training, YAML.
        held_out (RESULT): Recording that only measures whether the weights are better; may be
            repeated. (default: the last fifth of each RESULT)
        start (FILE): Weights to begin with. (default: shipped)
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
