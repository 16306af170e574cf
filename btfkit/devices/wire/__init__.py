"""The wire protocol: what the bytes between computer and rig mean. docs/capture.md has it in full."""
