"""NeuBTF while it is fitted: latents, encoder, guidance."""
