"""The paper's experiment: accuracy of our method beside the paper's solver and simpler methods."""
