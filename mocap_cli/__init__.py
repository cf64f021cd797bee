"""The `mocap` command line: arguments in, one call, results out."""
