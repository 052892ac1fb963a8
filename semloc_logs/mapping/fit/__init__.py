"""Whether the poses of a log fit its range data, and what is wrong where they do not."""
