"""Cameras, stages and lights of a rig, and the engine that runs a measurement."""
