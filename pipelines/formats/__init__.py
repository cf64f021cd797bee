"""Every foreign file format, one module each, in a folder for each kind; registered by entry points."""
