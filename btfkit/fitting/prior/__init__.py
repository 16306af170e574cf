"""What models are told of directions that no pair covers: a relief with analytic reflectance."""
