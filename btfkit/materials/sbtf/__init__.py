"""SBTF as it is used: NeuMIP's evaluation, its rays bent by curvature."""
