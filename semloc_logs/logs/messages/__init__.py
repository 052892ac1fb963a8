"""Messages -> frames: one small converter a message type."""
