"""The reference's applications and connections, turned into ordinary demands.

The files of the reference's operators record who demands what. The reference's custom resources
record what is deployed. Neither the files nor the custom resources contain the ids of the demands.
These ids come from a map that a person checks.
"""
