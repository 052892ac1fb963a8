"""Hypotheses, verification, ICP, pose and covariance (paper 3.5)."""
