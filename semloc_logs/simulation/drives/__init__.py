"""Vehicles that drive through a world, and what their sensors record on the way."""
