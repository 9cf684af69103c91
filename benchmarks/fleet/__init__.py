"""Many vehicles: what a fleet's model finds, and solves of tables in shards."""
