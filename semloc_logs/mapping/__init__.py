"""Log -> session map: keyframes, levelling, ground, submaps (paper 3.1)."""
