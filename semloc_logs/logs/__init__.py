"""Log -> typed frames, and results -> channels of a log.

The only code that knows containers and messages.
"""
