"""Queries over sessions and the acceptance of loop closures."""
