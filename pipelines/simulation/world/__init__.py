"""The simulated world: obstacles around the actor, which are rendered, hide the actor and are mapped."""

from pipelines.simulation.world.scene import World, build_world

__all__ = ["World", "build_world"]
