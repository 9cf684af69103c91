"""From images and clouds to correspondences; ``protocol`` defines what a matcher is.

Two matchers: ``structure`` needs no weights, ``cmrnext`` is the learned one.
"""
