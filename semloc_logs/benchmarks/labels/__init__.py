"""Classes from geometry and simulated sweeps against labelled logs."""
