"""What is minimized: small GTSAM graphs, joined.

``objective`` is Eq. 5 of the paper, ``latent_poses`` the error model, whose optimum and marginal
are reported with the preset ``auto``, and ``variables`` has the keys of both.
"""
