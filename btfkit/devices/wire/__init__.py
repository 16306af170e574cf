"""The wire protocol: what the bytes between computer and rig mean; in full in docs/capture.md."""
