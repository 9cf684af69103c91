"""``python -m calibgraph``: the command, where its script is not on the path."""

import os
import sys
from pathlib import Path

# Python looks for modules in the working folder first: a factors.py there is not ours.
if not sys.flags.safe_path and Path(__file__).parents[1] != Path.cwd():
    sys.path[:] = [entry for entry in sys.path if os.path.abspath(entry) != os.getcwd()]

from calibgraph.cli.app import main

if __name__ == "__main__":
    main()
