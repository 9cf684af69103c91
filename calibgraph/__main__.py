"""``python -m calibgraph``: the command, where its script is not on the path."""

from calibgraph.cli.app import main

if __name__ == "__main__":
    main()
