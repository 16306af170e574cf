"""Radiometric and geometric calibration of captured sequences."""
