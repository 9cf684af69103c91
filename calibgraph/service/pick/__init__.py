"""A reference by hand: pairs of a pixel and a LiDAR point, and what they determine."""
