"""The paper's method, from correspondences to the optimum; start at ``joint.solve_joint``.

In the order of use: ``preprocess``, ``pnp`` and ``stage1``, ``camera_block`` and
``block_residuals`` with ``whitening`` and ``residual_scale``, ``frame_weights`` (not in the paper)
with ``frame_poses``, ``objective`` (the graph of Eq. 5, its minimum, the gate), ``error_model``
with ``elimination``, ``marginals``.
"""
