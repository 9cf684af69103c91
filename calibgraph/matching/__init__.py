"""From images and clouds to correspondences; ``protocol`` defines a matcher.

Two matchers: ``structure`` needs no weights, ``cmrnext`` is the learned one.
"""
