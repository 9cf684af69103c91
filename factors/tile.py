"""The layout of a tile: a few hundred correspondences whose intermediate values stay in the cache.

A tile is a (ROWS, TILE) array; each row holds one quantity, so that the loops over it vectorize.
"""

FAST = {"reassoc", "contract", "nsz", "arcp"}
"""The arithmetic that LLVM may assume; NaN and infinity keep their meaning."""

TILE = 256
"""Correspondences in a tile: its intermediate values fill the first-level cache."""

(RU, RV, UX, UY, UZ, VX, VY, VZ, X, Y, Z, PSI, PRODUCT) = range(13)
"""Rows of a tile: the residual, the derivatives of u and v by the point, the point in the camera
frame, the loss' weight psi, and scratch for products."""
ROWS = 13

(A, B, W) = (X, Y, Z)
"""Of an undistorted pinhole, in place of the point: x/z, y/z and 1/z."""

MATRICES = 3
"""Rows of the whitening if it is matrices; 1 if it is numbers, 0 if there is none."""
