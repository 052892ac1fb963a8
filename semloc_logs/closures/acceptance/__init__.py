"""Which alignments are loop closures: probability, consistency, ambiguity."""
