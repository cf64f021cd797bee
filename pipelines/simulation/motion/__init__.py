"""How the simulated actor moves: scripted actions, or somebody's recorded motion put on the actor's bones."""
