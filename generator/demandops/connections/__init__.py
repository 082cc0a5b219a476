"""How connections are carried: routes."""
