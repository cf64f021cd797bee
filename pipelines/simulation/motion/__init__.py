"""Motion of the simulated actor: scripted actions, or recorded motion put on the actor's bones."""
