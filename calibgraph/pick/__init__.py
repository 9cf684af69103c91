"""A reference by hand: pairs of a pixel and a LiDAR point, picked on a page, and their solve."""
