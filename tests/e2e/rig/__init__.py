"""A real cluster on loopback, without containers, for the end-to-end tests.

`tools` builds the programs, `cluster.Rig` starts them and is all that a test needs. Nothing is
imported here, so that the programs can be built by a Python that has no packages installed.
"""
