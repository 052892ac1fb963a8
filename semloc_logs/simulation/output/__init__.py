"""Simulated drives as logs."""
