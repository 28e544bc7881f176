"""Events in, estimates out: one frame through the chain, and the class for live use."""
