"""Sessions in one frame: a robust pose graph of their odometry and their closures."""
