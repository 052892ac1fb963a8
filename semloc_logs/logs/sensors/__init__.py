"""Sweeps, depth images and stereo pairs -> points."""
