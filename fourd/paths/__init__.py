"""Camera paths: their timing, splines through poses, presets, files of other programs, and how far they
lie from where people filmed. `fourd.trajectory` states a film; docs/paths.md tells its keys.
"""
