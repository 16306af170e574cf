"""Pictures of a material on simple shapes."""
