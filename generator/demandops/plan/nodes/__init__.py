"""Nodes of applications and services: their choice, their capacity, and moves to others."""
