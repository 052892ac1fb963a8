"""Cutting and turning subvolumes, the encoder-decoder (paper 3.2); the only room with torch."""
