"""The nouns: rig, correspondences, configuration, calibration, verdict; and all of SE(3).

Types that check themselves when data enter. Nothing here reads files, matches or solves.
"""
