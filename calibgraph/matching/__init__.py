"""From images and clouds to correspondences; ``protocol`` defines a matcher.

Two matchers: ``structure`` needs no download, ``cmrnext`` is the learned one.
"""
