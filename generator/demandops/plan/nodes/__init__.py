"""Nodes of applications and services: how nodes are chosen, their capacity, and moves off them."""
