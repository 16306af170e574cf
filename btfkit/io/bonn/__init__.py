"""Bonn's binary `.btf`: header, body, colour models and images; reader and writer."""
