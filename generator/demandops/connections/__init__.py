"""How connections are carried: routes, and one module for each connection type.

A type defines its clients: which ones a connection needs, and the configuration that they read.
:mod:`.connection_type` has the interface, :mod:`.connection_types` lists the types. Nothing here
knows demands or claims.
"""
