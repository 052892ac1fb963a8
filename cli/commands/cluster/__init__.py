"""The commands that cut a stage into tasks for a cluster."""
