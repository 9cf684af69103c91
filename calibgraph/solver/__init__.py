"""The paper's method, from correspondences to the optimum; start at ``joint.solve_joint``.

In the order of use: ``preprocess``, ``pnp`` and ``stage1``, ``matches`` with ``robust``,
``frame_weights`` (not in the paper), ``two_pass`` (the graph of Eq. 5, its minimum, the gate),
``pairs`` and ``pair_refinement``, ``error_model`` with ``places``, ``components`` and ``sources``,
``solution``.
"""
