"""Training of the matcher ``cmrnext`` on trusted extrinsics."""
