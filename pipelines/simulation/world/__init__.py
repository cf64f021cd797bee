"""The simulated world: obstacles around the actor, which are rendered, hide the actor and are mapped."""
