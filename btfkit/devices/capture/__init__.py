"""The capture engine: a plan in, a sequence out, whatever happens in between."""
