"""Where a frame was at any time: pose streams, TF, satellite fixes, trajectory files."""
