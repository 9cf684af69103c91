"""The matcher `structure`, local correlation of clouds and images, pose consensus; no download.

First a global search locates every camera, from a guess that may be far off (`global_search`):

1. `correlation_maps`: windows of LiDAR points are correlated with the image at all its places, by
   inverse range and intensity (`correlation_kernels`: their compiled loops).
2. `box_search`: the poses within the range at which most windows agree (`consensus.maximize`).
3. `pose_refinement`: each candidate pose is refined, and accepted if its z-score is high enough.
4. `proposals`: a located camera proposes poses for the others: by known relative poses, by features
   that both see (`epipolar`), and by the guess.

Then one round per level of a coarse-to-fine `schedule`, each from the last estimate:

1. `windows`: the windows of the cloud that the camera sees (`directions`: angles and visibility).
2. `shift_scores`: the score of the image under each window, at every shift of a grid; windows of
   one direction and depth are one group.
3. `consensus`: the pose at which the groups' shifts agree best, and its z-score.
4. `peaks`: each group's own best shift near the consensus, with the directions that it constrains:
   one correspondence.

`matcher` joins these steps; `prepared_cloud` and `frame_cache` hold its input. A z-score is the
summed score at a pose in standard deviations of chance agreement.

Shifts and resolutions are angles, so that one schedule serves every focal length. Results depend
neither on the order of the points in a file nor on rings.
"""

from calibgraph.matching.structure.matcher import StructureMatcher

__all__ = ["StructureMatcher"]
