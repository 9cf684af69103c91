"""The paper's method, from correspondences to the optimum; start at ``joint.solve_joint``.

In the order of use: ``preprocess`` (section 3.4), ``pnp`` and ``stage1`` (3.3), ``frame_weights``
(ours), ``factor_graph`` (all of Eq. 5), ``objective`` (its minimum, the gate), ``covariance``.
"""
