"""One or several logs read once, as clouds with poses in bounded memory."""
