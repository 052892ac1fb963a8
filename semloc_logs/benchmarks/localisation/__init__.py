"""Whole localisation beside its peers in an unseen simulated city."""
