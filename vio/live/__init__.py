"""Events in, estimates out: one frame through the pipeline, and the class for live use."""
