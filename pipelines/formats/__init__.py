"""Every foreign file format, one module each, registered by an entry point."""
