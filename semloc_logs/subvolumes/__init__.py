"""Cutting and turning subvolumes; the encoder-decoder and its training (paper 3.2). torch is
imported here only.
"""
