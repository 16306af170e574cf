"""Campaigns: hours of mutated inputs, kills, full disks, malice and random queries (make campaign).

They are no tests: what one finds becomes a test. Seeds decide everything, so that a find is repeated
with `python -m campaigns NAME --seeds N:N+1`.
"""
