"""Studies of the causes of reconstruction error: their settings, and what their cameras see."""
