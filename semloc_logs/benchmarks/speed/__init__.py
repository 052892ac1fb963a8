"""Figures of speed: reading, fusion, encoder, search, verification."""
