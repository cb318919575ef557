"""The viewer on one's own machine: `python -m fourd.view [SCENE]`.

`server` answers a browser on this machine and nobody else, `live` renders asked-for views through the
generators, `job` takes dropped videos and runs the workflow on them. The standard library's server does:
there is one user, a handful of addresses, and nothing to be configured.
"""
