"""Can the result be used? ``assess`` makes the checks, ``probability.judge`` the verdict."""
