"""Log -> typed frames, and results -> channels of a log: the only code that knows containers and
messages.
"""
