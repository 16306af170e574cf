"""Pose manifests: any images, and a table that says how each was lit and seen."""
