"""Motion: from a keyframe to joint targets, on Pinocchio, coal, OMPL and toppra."""
