"""Pictures of a simulated flight, rendered on the processor: no graphics card, no system libraries."""
