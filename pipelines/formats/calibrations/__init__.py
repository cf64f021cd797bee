"""Lenses and places of cameras, as programs that calibrate write them."""
