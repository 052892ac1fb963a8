"""A procedural street and simulated drive logs with ground truth."""
