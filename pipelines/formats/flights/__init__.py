"""What a manifest names, as records, whichever format holds it."""
