"""What takes a training step: compiled kernels, plain torch, or fused kernels on a GPU."""
