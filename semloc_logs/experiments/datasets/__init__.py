"""Public data sets of driving as logs with truth: KITTI odometry, SemanticKITTI, NCLT, Boreas."""
