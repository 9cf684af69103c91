"""A result for viewers: Rerun recordings, and MCAP files for Foxglove."""
