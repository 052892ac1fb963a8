"""Closures -> channels of a log: as a copy, in place, or beside it."""
