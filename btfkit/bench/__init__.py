"""Run time against error, of every model on one machine."""
