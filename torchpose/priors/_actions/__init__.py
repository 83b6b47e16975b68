"""Hold action spaces, the postures of one action, and banks of several."""
