"""How connections are carried: routes, and one module for each connection type.

A connection type defines which clients a connection needs, and the configuration that these clients
read. :mod:`.connection_type` has the interface, and :mod:`.connection_types` lists the types. No
module of this package knows demands or claims.
"""
