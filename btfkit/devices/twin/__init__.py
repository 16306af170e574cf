"""The twin: a rig that exists in this process only, and obeys physics that are known.

It shares no camera, noise, distortion, falloff or rectification code with the calibration that
is tested against it.
"""
