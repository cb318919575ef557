"""Camera paths as files of other programs, and how far films lie from where people filmed.

`fourd.trajectory` states and places a film; docs/paths.md tells its keys.
"""
