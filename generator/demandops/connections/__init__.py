"""How connections are carried: routes, and one module for each connection type.

A type knows all about its clients: what they need, which there are and what they read.
:mod:`.connection_type` has the interface, :mod:`.connection_types` lists the types. Nothing here
knows demands or claims.
"""
