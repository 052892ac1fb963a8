"""Whether the poses of a log fit its range data, and the fault where they do not."""
