"""Vocabulary, Hamming embedding, index and search (paper 3.3, 3.4)."""
