"""Cameras recovered from the films alone: hand-held phones without calibration or common clock."""
