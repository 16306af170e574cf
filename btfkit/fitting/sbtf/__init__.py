"""SBTF while it is fitted: NeuMIP's training, on curved surfaces too."""
