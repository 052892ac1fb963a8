"""What a log contains and whether it can be mapped, known without a whole pass over it."""
