"""Closures against the truth."""
