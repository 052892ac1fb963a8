"""What LIDARs and cameras measure in a world."""
