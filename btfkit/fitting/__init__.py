"""Fitting: one trainable a model, and the one training loop. Needs torch."""
