"""The command of the learned matcher: what is in a file of weights."""

from pathlib import Path
from typing import Annotated

from calibgraph.cli import outputs
from calibgraph.cli.options import JsonOption
from calibgraph.cli.terminal import print_json, terminal


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
