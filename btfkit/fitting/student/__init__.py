"""A small NeuMIP while it is fitted: to data, or to the answers of a larger model."""
