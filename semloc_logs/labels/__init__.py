"""Label spaces, and labels from the log or from geometry."""
