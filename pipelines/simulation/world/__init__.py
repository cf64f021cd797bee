"""The simulated world: what stands around the actor, to look at, to hide behind and to be mapped."""

from pipelines.simulation.world.scene import World, build_world

__all__ = ["World", "build_world"]
