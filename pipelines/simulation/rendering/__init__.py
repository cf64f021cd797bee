"""Pictures of a simulated flight, rendered on the processor: no graphics card, no system libraries."""

from pipelines.simulation.rendering.renderer import Renderer

__all__ = ["Renderer"]
