"""Whole flights for programs that show them: skeleton, cameras, map and pictures in one recording."""
