"""How good it is, by the paper's protocol: our ways beside the paper's and simpler ones."""
