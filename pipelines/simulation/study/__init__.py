"""Studies of the causes of reconstruction error: their settings, and the filmed scenes."""
