"""Poses of tracked tools over time: trackers, calibration, recording. Pure Python, no MRML, no Qt."""
