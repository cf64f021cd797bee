"""What docs/extending.md shows, added from outside the package."""
