"""Nodes: what runs where: the choice, its capacity, and moves to other nodes."""
