"""Microgeometry: reliefs, procedural materials, and the tracer that turns them into BTFs."""
