"""NeuMIP as it is used: spec, arrays, evaluation."""
