"""The command of the learned matcher: what is in a file of weights."""

from pathlib import Path

from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.terminal import print_json, terminal


def weights(
    file: Path = Argument(..., metavar="FILE", help="Weights, .tar or .safetensors."),
    out: Path | None = Option(None, metavar="FILE", help="Convert to this .safetensors file."),
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Check a file of CMRNext weights, print what is in it, and convert it to safetensors."""
    from calibgraph.files import require_new_file

    if out is not None:
        require_new_file(out, ".safetensors", force=force)
    from calibgraph.matching.cmrnext import load_checkpoint

    checkpoint = load_checkpoint(file)
    if out is not None:
        checkpoint.save_safetensors(out)
    if as_json:
        print_json(checkpoint.summary())
    else:
        from calibgraph.cli.tables import print_weights

        print_weights(terminal(), checkpoint.summary(), out)
