"""Exports of whole flights for viewers: skeleton, cameras, map and pictures in one recording."""
