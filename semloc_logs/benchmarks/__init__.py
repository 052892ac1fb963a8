"""What `semloc benchmark` runs, one folder a subject."""
