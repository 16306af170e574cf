"""The autoencoders of Rainer et al. while they are fitted."""
