"""How well descriptors complete and are found again."""
