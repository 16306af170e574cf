"""What a material is looked at on: closed shapes, meshes, and the eye."""
