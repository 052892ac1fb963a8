"""Everything that is drawn: maps, closures, completed subvolumes, reliability diagrams."""
