"""Systems that localise pictures."""
